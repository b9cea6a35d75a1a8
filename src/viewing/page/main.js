// The viewer: makes its parts, and takes messages.

import { fittedCamera } from "./math.js";
import { lengthText } from "./dom.js";
import { readMessage, MessageError, ProtocolError, bytesOfBase64 } from "./messages.js";
import { Connection, Inbox } from "./connection.js";
import { MapStore } from "./map_store.js";
import { Scene } from "./scene.js";
import { Controls } from "./controls.js";
import { Stage } from "./stage.js";
import { CurrentPicture, ExactPicture } from "./pictures.js";
import { Compare } from "./compare.js";
import { Panel } from "./panel.js";
import { helpDialog } from "./help.js";
import { Overlay } from "./overlay.js";
import { Actions } from "./actions.js";

// Growth of the scene after which an untouched view is fitted again.
const REFIT_GROWTH = 1.25;

// A type that is not here is ignored.
const TAKERS = new Map([
  ["hello", "takeHello"], ["poses", "takePoses"], ["path", "takePath"], ["statistics", "takeStatistics"],
  ["map", "takeMap"], ["image", "takeImage"], ["refused", "takeRefused"],
]);

class Viewer extends Actions {
  constructor(root) {
    super();
    Object.assign(this, { root, updates: 0, revision: null, requests: 0, state: "starting" });
    Object.assign(this, { connected: false, following: false, untouched: true, file: false, fatal: false });
    root.classList.add("viewer");
    root.replaceChildren();
    this.scene = new Scene();
    this.overlay = new Overlay(root, this);
    this.panel = new Panel(root, {
      control: what => this.control(what),
      finish: () => this.askFinish(),
      layer: (name, on) => this.setLayer(name, on),
      background: name => this.setBackground(name),
      keyframe: by => this.stepKeyframe(by),
      pictures: open => this.setPictures(open),
    });
    this.help = helpDialog(root);
    this.inbox = new Inbox(data => this.take(data));
    this.buildStage();
    this.listenToKeys();
  }

  buildStage() {
    const { canvas } = this.overlay;
    this.controls = new Controls(canvas, {
      changed: () => this.cameraChanged(),
      taken: () => this.cameraTaken(),
      clicked: (x, y, touch) => this.clicked(x, y, touch),
      doubled: (x, y) => this.doubled(x, y),
      focalPixels: () => fittedCamera(this.scene.camera, canvas.clientWidth, canvas.clientHeight).fx,
    });
    try {
      this.stage = new Stage(canvas, this.scene, {
        advance: (now, seconds) => this.controls.advance(now, seconds),
        pose: () => this.controls.pose,
        drawn: () => this.overlay.setRange(this.stage, this.scene),
        failed: text => this.overlay.banner("graphics", text),
      });
      this.store = new MapStore((message, transfer) => this.stage.sorter.post(message, transfer));
      this.stage.useStore(this.store);
    } catch (error) {
      this.fatal = true;
      this.panel.setStatus("bad", "no picture");
      this.overlay.banner("graphics", error.message);
      return;
    }
    this.current = new CurrentPicture(this.panel.pictures, this.stage, this.scene);
    this.exact = new ExactPicture(this.overlay.stage);
    this.compare = new Compare(this.overlay.stage, this.stage, this.scene, {
      ask: id => this.askKeyframe(id),
      closed: () => this.choose(null),
      step: by => this.stepKeyframe(by),
      exact: (id, pose, camera) => this.askRender("error", pose, camera, id),
    });
    this.stage.invalidate();
  }

  // Plays the messages of a file, or connects.
  start() {
    if (this.fatal) {
      this.overlay.empty.hidden = true;
      return;
    }
    const held = [...document.querySelectorAll("script.message")];
    if (held.length > 0) {
      this.play(held);
      return;
    }
    if (!location.host) {
      this.overlay.empty.hidden = true;
      this.panel.setStatus("bad", "nothing to show");
      this.overlay.banner("connection", "This file holds no messages, and has no keysplat behind it.");
      return;
    }
    this.connection = new Connection(data => this.inbox.put(data), state => this.connectionChanged(state));
  }

  play(held) {
    this.file = true;
    this.compare.kept = held.length;
    for (const node of held) {
      // Decoded when its turn comes: many at once would fill the memory.
      this.inbox.put(() => {
        const text = node.textContent.trim();
        node.remove();
        return node.dataset.form === "binary" ? bytesOfBase64(text) : text;
      });
    }
  }

  connectionChanged(state) {
    this.connected = state.kind === "connected";
    if (state.kind === "connected") {
      this.overlay.banner("connection", null);
    } else if (state.kind === "waiting") {
      this.inbox.clear();
      const silence = state.failures > 1 ? "keysplat does not answer." : "The connection to keysplat is lost.";
      const why = state.why ? `keysplat closed the connection: ${state.why}.` : silence;
      const pause = state.seconds < 1 ? "a moment" : `${Math.round(state.seconds)} s`;
      this.overlay.banner("connection", `${why} Next try in ${pause}; what is shown stays.`, () => this.connection.hurry());
    }
    this.state = { connecting: "connecting", connected: "connected", waiting: "reconnecting" }[state.kind];
    this.showStatus();
  }

  showStatus() {
    const { hello } = this.scene;
    const phase = this.panel.phaseText();
    if (this.file) {
      this.panel.setStatus("done", hello ? ["from this file", hello.sensor].filter(Boolean).join(" · ") : "from this file");
    } else if (this.state === "connected" && hello) {
      const done = !hello.live || phase.startsWith("done");
      this.panel.setStatus(done ? "done" : "live", ["connected", hello.live ? phase : "finished", hello.sensor].filter(Boolean).join(" · "));
    } else {
      this.panel.setStatus("bad", this.state);
    }
  }

  // Takes one message, whatever it holds; no exception leaves this.
  async take(given) {
    try {
      const message = readMessage(typeof given === "function" ? given() : given);
      const taker = TAKERS.get(message.type);
      if (taker) {
        await this[taker](message);
      }
    } catch (error) {
      if (error instanceof ProtocolError) {
        this.overlay.banner("connection", error.message);
        this.state = "another protocol";
        this.connected = false;
        this.inbox.clear();
        this.connection?.stop();
        this.showStatus();
      } else {
        const why = error instanceof MessageError ? error.message : "A message could not be shown.";
        this.overlay.banner("message", `${why} It is left out.`, null, 8000);
      }
    }
  }

  takeHello(hello) {
    this.scene.forget();
    this.scene.hello = hello;
    this.untouchedRadius = null;
    this.compare.forget();
    this.current.clear();
    this.panel.setHello(hello);
    this.overlay.setHello(hello);
    this.connection?.greeted();
    this.showStatus();
    this.setPictures(this.current.open);
    this.stage.invalidate();
  }

  takePoses(message) {
    this.scene.takePoses(message);
    this.sceneChanged();
    this.panel.setKeyframes(this.scene.keyframes.size, this.stage.chosen);
    this.current.changed();
    this.compare.changed();
    if (this.following && this.scene.current) {
      const { p, q, distance } = this.scene.behindCurrent(this.store);
      this.controls.flyTo({ p, q }, distance);
    }
  }

  takePath(message) {
    this.scene.takePath(message);
    const range = this.scene.errorRange();
    this.panel.setError(range === null ? null : lengthText(range, "metres"));
    this.stage.invalidate();
  }

  takeStatistics(message) {
    this.panel.takeStatistics(message.entries);
    this.showStatus();
  }

  async takeMap(map) {
    this.store.apply(map);
    this.updates += 1;
    await this.stage.reach();
    this.revision = map.revision;
    this.overlay.setProgress(this.store.gaussians, map.gaussians, map.complete !== false);
    this.send({ type: "taken", revision: map.revision });
    this.sceneChanged();
    this.current.changed();
    this.compare.changed();
    this.countAgain();
  }

  async takeImage(image) {
    if (image.of === "current") {
      await this.current.takeImage(image);
    } else if (image.of === "keyframe") {
      await this.compare.takeImage(image);
    } else if (image.of === "render" && image.kind === "error") {
      await this.compare.takeExact(image);
    } else if (image.of === "render") {
      await this.exact.take(image);
    }
  }

  takeRefused(message) {
    this.compare.refused(message);
    if (message.what === "render") {
      this.exact.hide();
    }
    this.overlay.note(`Not done: ${message.why}`);
  }

  send(message) {
    return Boolean(this.connection?.send(message));
  }

  // Fits an untouched view to a scene that has come or grown, and keeps the controls' measures.
  sceneChanged() {
    const { up } = this.scene.measure();
    const { radius } = this.scene.extent(this.store);
    this.controls.up = up;
    this.controls.radius = radius;
    const known = this.scene.keyframes.size > 0 || this.store.gaussians > 0;
    this.overlay.empty.hidden = known;
    const last = this.untouchedRadius;
    if (this.untouched && known && !this.following && (!last || radius > last * REFIT_GROWTH || radius < last / REFIT_GROWTH)) {
      this.untouchedRadius = radius;
      this.fit(true);
    }
    this.stage.invalidate();
  }

  // What tests ask for.
  testInterface() {
    return {
      settled: async () => {
        while (!this.fatal && !(this.inbox.idle && this.stage.settled)) {
          await new Promise(resolve => setTimeout(resolve, 8));
        }
      },
      draw: async ({ p, q, camera }) => (this.fatal ? null : this.stage.draw({ p, q }, camera)),
      state: () => ({
        gaussians: this.store?.gaussians ?? 0,
        chunks: this.store?.chunks.size ?? 0,
        keyframes: this.scene.keyframes.size,
        updates: this.updates,
        revision: this.revision,
        connected: this.connected,
        frameMs: this.stage?.frameMs ?? null,
        digest: this.store?.digest ?? 0,
        pose: this.controls.pose,
        distance: this.controls.distance,
      }),
    };
  }
}

export function mount(root) {
  const viewer = new Viewer(root);
  window.keysplat = viewer.testInterface();
  viewer.start();
}

if (document.getElementById("viewer")) {
  mount(document.getElementById("viewer"));
}
