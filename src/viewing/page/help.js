// Dialogs: the keys, and a question before something that cannot be undone.

import { element, iconButton } from "./dom.js";

const HELP_ROWS = [
  ["drag", "orbit"], ["right drag, shift drag, two fingers", "move sideways"], ["wheel, pinch, + −", "nearer, farther"],
  ["W A S D, Q E", "fly; with shift faster"], ["arrow keys", "turn"], ["0", "whole scene"], ["f", "follow the camera"],
  ["click on a keyframe", "stand in it and compare"], ["[ ]", "previous, next keyframe"], ["double click, m", "keyframes that see the point, the middle one"],
  ["c", "next colouring"], ["x", "exact picture"], ["space", "pause, go"], ["n", "one step"], ["p", "panel"], ["?", "this help"], ["Escape", "close"],
];

export function helpDialog(parent) {
  const rows = HELP_ROWS.map(([keys, effect]) => element("div", {}, element("dt", {}, keys), element("dd", {}, effect)));
  const dialog = element("dialog", { class: "help", "aria-label": "Keys" });
  const close = iconButton("close", "Close", () => dialog.close());
  dialog.append(element("header", {}, element("h3", {}, "Keys and gestures"), close), element("dl", {}, ...rows));
  dialog.addEventListener("click", event => event.target === dialog && dialog.close());
  parent.append(dialog);
  return dialog;
}

// Calls `act` where the answer is yes.
export function askDialog(parent, question, yes, act) {
  const dialog = element("dialog", { class: "ask", "aria-label": question });
  const close = () => dialog.close();
  dialog.append(element("p", {}, question), element("div", { class: "row" },
    element("button", { type: "button", onclick: close }, "Go back"),
    element("button", { type: "button", class: "strong", onclick: () => {
      close();
      act();
    } }, yes)));
  dialog.addEventListener("close", () => dialog.remove());
  parent.append(dialog);
  dialog.showModal();
}
