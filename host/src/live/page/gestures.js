// Mouse, pen, fingers and wheel on the map.

/** Moved no farther than this it was a click, px. */
const CLICK_PX = 5;

/**
 * Turns pointers into pan, zoom and clicks. `tool()` names the tool in hand; `handlers` are told
 * `pan(dx, dy)`, `zoom(factor, x, y)`, `hover(x, y)`, `leave()`, `click(x, y)`, `drag(x0, y0, x, y)` and `drop(x0, y0, x, y)`,
 * the last two while the tool is one that is dragged.
 */
export function watchGestures(canvas, tool, handlers) {
  const pointers = new Map();
  let pressed = null;
  let pinch = null;

  const at = (event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };

  const pinchOf = () => {
    const [a, b] = [...pointers.values()];
    return { x: (a[0] + b[0]) / 2, y: (a[1] + b[1]) / 2, apart: Math.max(20, Math.hypot(a[0] - b[0], a[1] - b[1])) };
  };

  canvas.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 && event.button !== 1) return;
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, at(event));
    if (pointers.size === 1) {
      pressed = { from: at(event), moved: false };
    } else {
      pressed = null;
      pinch = pointers.size === 2 ? pinchOf() : null;
    }
  });

  canvas.addEventListener("pointermove", (event) => {
    const [x, y] = at(event);
    handlers.hover(x, y);
    const last = pointers.get(event.pointerId);
    if (!last) return;
    pointers.set(event.pointerId, [x, y]);
    if (pinch && pointers.size === 2) {
      const next = pinchOf();
      handlers.pan(next.x - pinch.x, next.y - pinch.y);
      handlers.zoom(next.apart / pinch.apart, next.x, next.y);
      pinch = next;
    } else if (pressed) {
      pressed.moved ||= Math.hypot(x - pressed.from[0], y - pressed.from[1]) > CLICK_PX;
      if (!pressed.moved) return;
      if (tool() === "pose") {
        handlers.drag(...pressed.from, x, y);
      } else {
        if (canvas.dataset.tool === "") canvas.dataset.tool = "drag";
        handlers.pan(x - last[0], y - last[1]);
      }
    }
  });

  const up = (event) => {
    if (!pointers.delete(event.pointerId)) return;
    const [x, y] = at(event);
    if (canvas.dataset.tool === "drag") canvas.dataset.tool = "";
    if (pressed && pointers.size === 0 && event.type === "pointerup") {
      if (tool() === "pose") handlers.drop(...pressed.from, x, y);
      else if (!pressed.moved) handlers.click(x, y);
    }
    if (pointers.size === 0) pressed = null;
    if (pointers.size < 2) pinch = null;
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("pointerleave", () => handlers.leave());

  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    // Lines and pages to pixels; a trackpad's pinch comes as a wheel with Ctrl.
    const px = event.deltaY * [1, 18, 240][event.deltaMode];
    const factor = Math.exp(-px * (event.ctrlKey ? 0.01 : 0.0018));
    handlers.zoom(Math.min(3, Math.max(1 / 3, factor)), ...at(event));
  }, { passive: false });
}
