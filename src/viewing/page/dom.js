// Elements, icons and numbers of the page.

// An element with properties and children. `on…` properties are listeners, `class` and `aria-…` are attributes.
export function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === undefined || value === null) {
      continue;
    }
    if (name.startsWith("on")) {
      made.addEventListener(name.slice(2), value);
    } else if (name in made && name !== "class") {
      made[name] = value;
    } else {
      made.setAttribute(name, value);
    }
  }
  made.append(...children.filter(child => child !== null && child !== undefined));
  return made;
}

const ICON_PATHS = {
  fit: "M3 8V3h5M16 3h5v5M21 16v5h-5M8 21H3v-5M9 9h6v6H9z",
  follow: "M4 8h11v9H4zM15 11l5-3v9l-5-3M7.5 12.5h4",
  plus: "M12 5v14M5 12h14",
  minus: "M5 12h14",
  help: "M9 9a3 3 0 1 1 4.2 2.8c-.8.4-1.2 1-1.2 2M12 17.5v.01",
  panel: "M3 5h18v14H3zM15 5v14",
  pause: "M8 5v14M16 5v14",
  go: "M7 5l11 7-11 7z",
  step: "M6 5l8 7-8 7zM18 5v14",
  finish: "M6 6h12v12H6z",
  refine: "M20 11a8 8 0 1 0-2 6M20 5v6h-6",
  close: "M6 6l12 12M18 6L6 18",
  previous: "M15 5l-7 7 7 7",
  next: "M9 5l7 7-7 7",
  exact: "M4 8V5h4l1.5-2h5L16 5h4v14H4V8M12 16a4 4 0 1 0 0-8 4 4 0 0 0 0 8",
  full: "M4 9V4h5M15 4h5v5M20 15v5h-5M9 20H4v-5",
};

export function icon(name) {
  const space = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(space, "svg");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("aria-hidden", "true");
  const path = document.createElementNS(space, "path");
  path.setAttribute("d", ICON_PATHS[name]);
  svg.append(path);
  return svg;
}

export function changeIcon(button, name) {
  if (button.dataset.icon !== name) {
    button.dataset.icon = name;
    button.querySelector("svg").replaceWith(icon(name));
  }
}

// A button with an icon, and a word where it has one.
export function iconButton(name, label, act, word) {
  const button = element("button", { type: "button", "aria-label": label, title: label, onclick: act }, icon(name));
  button.dataset.icon = name;
  if (word) {
    button.append(element("span", {}, word));
  }
  return button;
}

export function checkbox(label, checked, change, swatch) {
  const input = element("input", { type: "checkbox", checked, onchange: () => change(input.checked) });
  const mark = swatch ? element("i", { class: "swatch", style: `--swatch: ${swatch}` }) : null;
  return element("label", { class: "check" }, input, mark, element("span", {}, label));
}

// Sets a text only where it differs: the browser lays out nothing anew then.
export function setText(node, text) {
  if (node.textContent !== text) {
    node.textContent = text;
  }
}

export function isNumber(value) {
  return typeof value === "number" && Number.isFinite(value);
}

export function countText(value) {
  return isNumber(value) ? Math.round(value).toLocaleString("en") : "–";
}

export function fixedText(value, digits, unit = "") {
  return isNumber(value) ? value.toFixed(digits) + unit : "–";
}

export function bytesText(value) {
  if (!isNumber(value)) {
    return "–";
  }
  return value >= 1e9 ? (value / 1e9).toFixed(2) + " GB" : Math.round(value / 1e6) + " MB";
}

export function durationText(seconds) {
  if (!isNumber(seconds)) {
    return "–";
  }
  const s = Math.max(0, Math.round(seconds));
  if (s < 60) {
    return `${s} s`;
  }
  const m = Math.floor(s / 60);
  return m < 60 ? `${m} min ${s % 60} s` : `${Math.floor(m / 60)} h ${m % 60} min`;
}

// A length in the map's units: centimetres below one metre.
export function lengthText(value, units) {
  if (!isNumber(value)) {
    return "–";
  }
  if (units === "arbitrary") {
    return value.toPrecision(2);
  }
  return Math.abs(value) < 1 ? (value * 100).toFixed(value < 0.1 ? 1 : 0) + " cm" : value.toFixed(value < 10 ? 2 : 1) + " m";
}
