// Numbers for people.

/** Microseconds as 1:23, with tenths where asked. */
export function clock(us, tenths = false) {
  const all = Math.max(0, us) / 1e6;
  const whole = tenths ? Math.floor(all * 10) / 10 : Math.floor(all);
  const hours = Math.floor(whole / 3600);
  const minutes = Math.floor(whole / 60) % 60;
  const rest = whole % 60;
  const seconds = tenths ? rest.toFixed(1).padStart(4, "0") : String(rest).padStart(2, "0");
  return hours ? `${hours}:${String(minutes).padStart(2, "0")}:${seconds}` : `${minutes}:${seconds}`;
}

/** Metres with as many digits as they deserve. */
export function metres(m) {
  const size = Math.abs(m);
  if (size >= 1000) return `${(m / 1000).toFixed(2)} km`;
  if (size >= 100) return `${m.toFixed(1)} m`;
  return `${m.toFixed(2)} m`;
}

/** A round length for a scale bar: px it takes, and its name. */
export function roundLength(pxPerM, mostPx) {
  let step = 0.01;
  for (let k = 0; k < 40; k += 1) {
    const next = [1, 2, 5][k % 3] * 10 ** Math.floor(k / 3 - 2);
    if (next * pxPerM > mostPx) break;
    step = next;
  }
  const name = step >= 1000 ? `${step / 1000} km` : step >= 1 ? `${step} m` : `${Math.round(step * 100)} cm`;
  return { px: step * pxPerM, metres: step, name };
}

/** Seconds in words. */
export function seconds(ms) {
  const s = Math.round(ms / 1000);
  return s < 90 ? `${s} s` : s < 5400 ? `${Math.round(s / 60)} min` : `${Math.round(s / 3600)} h`;
}

/** The name of a state for people. */
export function stateName(state) {
  return { tracking: "Tracking", uncertain: "Uncertain", lost: "Lost" }[state] ?? "–";
}
