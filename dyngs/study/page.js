"use strict";
// Panels of one view: the truth and each model above, the errors below; all show the same part of the image.
const views = JSON.parse(document.getElementById("views").textContent);
const byId = (id) => document.getElementById(id);
const MOST = 32;
let panels = [], zoom = 1, centre = [0.5, 0.5], size = [1, 1], shown = 0;

function loaded(source) {
  return new Promise((resolve, reject) => {
    const image = new Image();
    image.onload = () => resolve(image);
    image.onerror = reject;
    image.src = source;
  });
}

function pixelsOf(image) {
  const canvas = document.createElement("canvas");
  canvas.width = image.naturalWidth;
  canvas.height = image.naturalHeight;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  return { canvas, context, data: context.getImageData(0, 0, canvas.width, canvas.height) };
}

// Mean difference of the channels times gain, from black over red and yellow to white.
function errorOf(truth, model, gain) {
  const result = pixelsOf(truth.image), out = result.data.data, a = truth.data.data, b = model.data.data;
  for (let i = 0; i < out.length; i += 4) {
    const mean = (Math.abs(a[i] - b[i]) + Math.abs(a[i + 1] - b[i + 1]) + Math.abs(a[i + 2] - b[i + 2])) / 765;
    const heat = Math.min(1, gain * mean) * 3;
    for (let c = 0; c < 3; c++) out[i + c] = 255 * Math.min(1, Math.max(0, heat - c));
    out[i + 3] = 255;
  }
  result.context.putImageData(result.data, 0, 0);
  return result.canvas;
}

function panel(title, source, row) {
  const figure = document.createElement("figure"), caption = document.createElement("figcaption");
  const canvas = document.createElement("canvas");
  caption.textContent = title;
  figure.append(caption, canvas);
  figure.style.gridRow = row;
  canvas.width = canvas.height = 1;
  byId("panels").append(figure);
  listen(canvas);
  panels.push({ canvas, source });
}

function draw() {
  const width = size[0] / zoom, height = size[1] / zoom;
  centre = centre.map((c) => Math.min(1 - 0.5 / zoom, Math.max(0.5 / zoom, c)));
  const left = centre[0] * size[0] - width / 2, top = centre[1] * size[1] - height / 2;
  for (const { canvas, source } of panels) {
    canvas.width = Math.max(size[0], 320);
    canvas.height = Math.round((canvas.width * size[1]) / size[0]);
    const context = canvas.getContext("2d");
    context.imageSmoothingEnabled = false;
    context.drawImage(source, left, top, width, height, 0, 0, canvas.width, canvas.height);
  }
}

function zoomBy(factor, at) {
  const next = Math.min(MOST, Math.max(1, zoom * factor));
  centre = centre.map((c, i) => c + (at[i] - 0.5) * (1 / zoom - 1 / next));
  zoom = next;
  draw();
}

function whole() {
  zoom = 1;
  draw();
}

function listen(canvas) {
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  };
  let last = null;
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomBy(Math.exp(-0.002 * event.deltaY), place(event));
  }, { passive: false });
  canvas.addEventListener("pointerdown", (event) => {
    last = place(event);
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (last === null) return;
    const now = place(event);
    centre = centre.map((c, i) => c - (now[i] - last[i]) / zoom);
    last = now;
    draw();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { last = null; });
  canvas.addEventListener("dblclick", whole);
}

async function show(index) {
  const number = ++shown, view = views[index], gain = Number(byId("gain").value);
  const images = await Promise.all([view.truth, ...view.models.map((model) => model.image)].map(loaded));
  if (number !== shown) return; // another view was asked for meanwhile
  const [truth, ...models] = images.map((image) => Object.assign(pixelsOf(image), { image }));
  size = [truth.canvas.width, truth.canvas.height];
  byId("panels").replaceChildren();
  panels = [];
  panel("truth", truth.canvas, 1);
  models.forEach((model, i) => panel(`${view.models[i].name}: ${view.models[i].psnr.toFixed(2)} dB`, model.canvas, 1));
  models.forEach((model, i) => {
    panel(`error of ${view.models[i].name}`, errorOf(truth, model, gain), 2);
    panels[panels.length - 1].canvas.parentElement.style.gridColumn = i + 2;
  });
  draw();
  window.ready = true;
}

views.forEach((view, i) => byId("view").append(new Option(view.name, i)));
byId("view").addEventListener("change", (event) => show(event.target.value));
byId("gain").addEventListener("input", (event) => {
  byId("times").textContent = event.target.value;
  show(byId("view").value);
});
byId("nearer").addEventListener("click", () => zoomBy(2, [0.5, 0.5]));
byId("farther").addEventListener("click", () => zoomBy(0.5, [0.5, 0.5]));
byId("whole").addEventListener("click", whole);
show(0);
