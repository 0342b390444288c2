// The WebSocket: opens it, opens it again, says what is asked for. It knows nothing of what the frames mean.

const LEAST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 5000;
/** The server sends at least twice a second while something is shown; a line silent for so long is dead. */
const SILENCE_MS = 6000;

export class Connection {
  /** `onFrame(buffer)` gets every binary frame, `onText(text)` every text, `onState("open" | "lost")` every change. */
  constructor({ onFrame, onText, onState }) {
    this.onFrame = onFrame;
    this.onText = onText;
    this.onState = onState;
    this.state = "lost";
    this.socket = null;
    this.waitMs = LEAST_WAIT_MS;
    this.wish = { show: "ward" };
    this.heardAt = performance.now();
    /** Since when an answer is due. */
    this.askedAt = this.heardAt;
    document.addEventListener("visibilitychange", () => this.#ask());
    setInterval(() => this.#watch(), 1000);
    this.#open();
  }

  /** Says what is shown from now on; asked again after a reconnection and when a hidden tab comes back. */
  show(wish) {
    this.wish = wish;
    this.#ask();
  }

  /** Sends an order that is not repeated; false if there is no line to send it on. */
  send(order) {
    if (this.socket?.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(order));
    return true;
  }

  /** Seconds since the server was last heard. */
  silentFor() {
    return (performance.now() - this.heardAt) / 1000;
  }

  #ask() {
    this.askedAt = performance.now();
    this.send(document.hidden ? { show: "nothing" } : this.wish);
  }

  #open() {
    this.askedAt = performance.now();
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/live`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => this.#ask();
    socket.onmessage = (message) => this.#hear(message);
    socket.onclose = () => this.#lose(socket);
  }

  #hear(message) {
    this.heardAt = performance.now();
    this.waitMs = LEAST_WAIT_MS;
    this.#become("open");
    if (message.data instanceof ArrayBuffer) this.onFrame(message.data);
    else this.onText(message.data);
  }

  #lose(socket) {
    // A socket given up for dead may say so long after its successor has opened.
    if (socket !== this.socket) return;
    this.socket = null;
    this.#become("lost");
    setTimeout(() => this.#open(), this.waitMs);
    this.waitMs = Math.min(this.waitMs * 2, LONGEST_WAIT_MS);
  }

  #watch() {
    const silentMs = performance.now() - Math.max(this.heardAt, this.askedAt);
    if (document.hidden || !this.socket || silentMs < SILENCE_MS) return;
    const socket = this.socket;
    socket.close();
    this.#lose(socket);
  }

  #become(state) {
    if (this.state === state) return;
    this.state = state;
    this.onState(state);
  }
}
