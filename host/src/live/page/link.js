// The WebSocket: connects again by itself, answers orders, and asks for one view at a time.

const VERSION = 2;
const FIRST_WAIT_MS = 400;
const LONGEST_WAIT_MS = 8000;
/** The server says something each second. */
const SILENCE_MS = 4000;
const ANSWER_MS = 15000;

export class Link extends EventTarget {
  #socket = null;
  #wait = FIRST_WAIT_MS;
  #timer = 0;
  #orders = new Map();
  #next = 1;
  #wanted = null;
  #asked = null;
  heardAt = 0;
  retryAt = 0;
  connected = false;

  constructor() {
    super();
    addEventListener("online", () => this.#now());
    document.addEventListener("visibilitychange", () => document.visibilityState === "visible" && this.#now());
    setInterval(() => this.#watch(), 1000);
    this.#open();
  }

  /** Gives an order: resolves to what became of it, `{done, words}`. */
  order(command) {
    if (!this.connected) return Promise.resolve({ done: false, words: "There is no connection to the server." });
    const id = this.#next++;
    this.#send({ order: { id, command } });
    return new Promise((resolve) => {
      const timer = setTimeout(() => this.#settle(id, false, "No answer came."), ANSWER_MS);
      this.#orders.set(id, { resolve, timer });
    });
  }

  /** Asks for an instant. While one is on its way only the last of further ones is kept. */
  view(atUs) {
    this.#wanted = Math.max(0, Math.round(atUs));
    this.#askView();
  }

  /** No view is wanted any more. */
  dropView() {
    this.#wanted = null;
    this.#asked = null;
  }

  #askView() {
    if (this.#wanted === null || this.#asked !== null || !this.connected) return;
    this.#asked = this.#next++;
    this.#send({ view: { id: this.#asked, at_us: this.#wanted } });
    this.#wanted = null;
  }

  #send(message) {
    this.#socket?.send(JSON.stringify(message));
  }

  #settle(id, done, words) {
    const order = this.#orders.get(id);
    if (!order) return;
    this.#orders.delete(id);
    clearTimeout(order.timer);
    order.resolve({ done, words });
  }

  #open() {
    clearTimeout(this.#timer);
    this.retryAt = 0;
    const socket = new WebSocket(`ws://${location.host}/ws`);
    this.#socket = socket;
    this.heardAt = performance.now();
    socket.onmessage = (event) => socket === this.#socket && this.#heard(JSON.parse(event.data));
    socket.onclose = () => socket === this.#socket && this.#lost();
  }

  #heard(message) {
    this.heardAt = performance.now();
    switch (message.type) {
      case "hello":
        if (message.version !== VERSION) return location.reload();
        this.connected = true;
        this.#wait = FIRST_WAIT_MS;
        break;
      case "answer":
        this.#settle(message.id, message.done, message.words);
        return undefined;
      case "view": {
        // One that nobody waits for any more comes too late.
        const isWanted = message.id === this.#asked;
        if (isWanted) this.#asked = null;
        this.#askView();
        if (!isWanted) return undefined;
        break;
      }
      default:
    }
    this.dispatchEvent(new CustomEvent(message.type, { detail: message }));
    return undefined;
  }

  #lost() {
    this.#socket = null;
    this.connected = false;
    this.#asked = null;
    for (const id of [...this.#orders.keys()]) this.#settle(id, false, "The connection was lost before an answer came.");
    const wait = this.#wait * (0.8 + 0.4 * Math.random());
    this.#wait = Math.min(LONGEST_WAIT_MS, this.#wait * 1.7);
    this.retryAt = performance.now() + wait;
    this.#timer = setTimeout(() => this.#open(), wait);
    this.dispatchEvent(new Event("lost"));
  }

  /** Tries at once, where it waits to. */
  #now() {
    if (this.retryAt) this.#open();
  }

  /** A connection that has gone silent is given up: the network may have gone without a word. */
  #watch() {
    const socket = this.#socket;
    if (!socket || performance.now() - this.heardAt < SILENCE_MS) return;
    socket.onclose = null;
    socket.onmessage = null;
    socket.close();
    this.#lost();
  }
}
