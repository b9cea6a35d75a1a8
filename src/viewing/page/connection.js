// A WebSocket that is opened again when it closes, and messages in their order.

const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 15000;
// Without a hello within this time the peer is as good as gone.
const HELLO_WITHIN_MS = 20000;

function liveAddress() {
  const token = new URLSearchParams(location.search).get("token");
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  return `${scheme}//${location.host}/live${token === null ? "" : `?token=${encodeURIComponent(token)}`}`;
}

// Calls `onState({kind, …})` with kind "connecting", "connected" or "waiting" (and `seconds`, `why`), and `onData` for each message.
export class Connection {
  constructor(onData, onState) {
    this.onData = onData;
    this.onState = onState;
    this.failures = 0;
    this.stopped = false;
    this.wake = () => this.hurry();
    addEventListener("online", this.wake);
    this.open();
  }

  open() {
    clearTimeout(this.timer);
    this.timer = 0;
    this.onState({ kind: "connecting" });
    let socket;
    try {
      socket = new WebSocket(liveAddress());
    } catch {
      this.closed("The address of this page has no keysplat behind it.");
      return;
    }
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.helloTimer = setTimeout(() => socket.close(), HELLO_WITHIN_MS);
    };
    socket.onmessage = event => {
      if (this.socket === socket) {
        this.onData(event.data);
      }
    };
    socket.onclose = event => {
      if (this.socket === socket) {
        this.closed(event.reason);
      }
    };
  }

  // A hello has come: the next failure begins with the shortest pause again.
  greeted() {
    clearTimeout(this.helloTimer);
    this.failures = 0;
    this.onState({ kind: "connected" });
  }

  closed(reason) {
    clearTimeout(this.helloTimer);
    this.socket = null;
    if (this.stopped) {
      return;
    }
    const pause = Math.min(LONGEST_PAUSE_MS, FIRST_PAUSE_MS * 2 ** this.failures);
    this.failures += 1;
    this.timer = setTimeout(() => this.open(), pause);
    this.onState({ kind: "waiting", seconds: pause / 1000, why: reason, failures: this.failures });
  }

  // Tries at once.
  hurry() {
    if (this.timer) {
      this.open();
    }
  }

  stop() {
    this.stopped = true;
    clearTimeout(this.timer);
    clearTimeout(this.helloTimer);
    removeEventListener("online", this.wake);
    if (this.socket) {
      this.socket.close();
    }
  }

  send(message) {
    if (this.socket && this.socket.readyState === WebSocket.OPEN) {
      this.socket.send(JSON.stringify(message));
      return true;
    }
    return false;
  }
}

// Messages in the order in which they came, one at a time: the next waits until the last is done.
export class Inbox {
  constructor(take) {
    this.take = take;
    this.waiting = [];
    this.busy = false;
  }

  get idle() {
    return !this.busy && this.waiting.length === 0;
  }

  put(data) {
    this.waiting.push(data);
    if (!this.busy) {
      this.work();
    }
  }

  clear() {
    this.waiting.length = 0;
  }

  async work() {
    this.busy = true;
    while (this.waiting.length > 0) {
      await this.take(this.waiting.shift());
    }
    this.busy = false;
  }
}
