// What lies over the picture, made without HTML text, so that sites may forbid that (Trusted Types).

// Keys that do something for this scene.
function keysOf({ moves, views }) {
  const player = [["space", "play, pause"], ["← →", "one frame back, on"], ["L", "loop"]];
  return [
    ["drag, one finger", "turn"],
    ["right button, shift, two fingers", "move"],
    ["wheel, pinch, + −", "nearer, farther"],
    ["W A S D", "turn"],
    ...(moves ? player : []),
    ...(views.length > 1 ? [["C, shift C", "next, previous camera"]] : []),
    ["R", "back to that camera"],
    ...(document.fullscreenEnabled ? [["F", "full screen"]] : []),
    ["?", "this list"],
  ].flatMap(([key, action]) => [made("dt", {}, key), made("dd", {}, action)]);
}
const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];

function made(name, attributes, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

// Fills a shadow root, and returns its parts by their ids.
function controlsIn(root) {
  const style = new CSSStyleSheet();
  style.replaceSync(STYLE);
  root.adoptedStyleSheets = [style];
  const speeds = SPEEDS.map((x) => made("option", { value: x, ...(x === 1 && { selected: "" }) }, `${x}×`));
  root.replaceChildren(
    made("canvas", { id: "canvas", tabindex: 0, role: "img" }),
    made("slot", {}),
    made("button", { id: "next", hidden: "" }, "next view"),
    made("button", { id: "help", "aria-label": "Keys" }, "?"),
    made("div", { id: "keys", class: "panel", hidden: "" }, made("dl", {})),
    made("div", { id: "bar", class: "panel", hidden: "" },
      made("button", { id: "play", "aria-label": "Play" }, "▶"),
      made("input", { id: "time", type: "range", min: 0, max: 1, value: 0, "aria-label": "Time" }),
      made("span", { id: "seconds" }),
      made("label", {}, made("input", { id: "loop", type: "checkbox", checked: "" }), "loop"),
      made("select", { id: "speed", "aria-label": "Speed" }, ...speeds)),
    made("div", { id: "message", class: "panel", role: "status" }),
  );
  return Object.fromEntries([...root.querySelectorAll("[id]")].map((part) => [part.id, part]));
}
