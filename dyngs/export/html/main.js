// The page: reads the scene, draws it whenever something has changed, and offers `window.dyngs` to tests and scripts.

const SLOW = 50; // ms for a frame, from which on fewer pixels are drawn while things move
const COARSEST = 0.35;
const PATIENCE = 250; // ms without a change until all pixels are drawn again

class App {
  constructor(scene) {
    this.scene = scene;
    this.canvas = document.getElementById("canvas");
    this.renderer = rendererOf(this.canvas, scene, () => this.changed());
    this.camera = new OrbitCamera(scene);
    this.player = new Player(scene, () => this.changed());
    this.coarse = 1; // fraction of the pixels' sides that are drawn
    this.frames = 0;
    this.wanted = false;
    this.refining = 0;
    this.asked = null;
    steer(this.canvas, this.camera, () => this.changed());
    window.addEventListener("resize", () => this.changed());
    document.addEventListener("keydown", (event) => this.key(event));
    document.getElementById("help").addEventListener("click", () => this.help());
    this.canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    this.canvas.addEventListener("webglcontextrestored", () => window.location.reload());
  }

  changed() {
    clearTimeout(this.refining);
    this.request();
  }

  request() {
    if (this.wanted) return;
    this.wanted = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.wanted = false;
    if (this.asked) return; // a script says what is drawn
    const since = now - (this.last ?? -1e9);
    this.last = now;
    if (this.player.playing) this.player.advance(Math.min(since, 1000) / 1000);
    const change = since > SLOW ? 0.85 : since < SLOW / 2 ? 1.1 : 1;
    if (since < 500 || this.running) this.coarse = Math.min(Math.max(this.coarse * change, COARSEST), 1);
    this.drawNow(this.coarse);
    ++this.frames;
    this.running = this.player.playing;
    if (this.running) this.request();
    else if (this.coarse < 1) this.refining = setTimeout(() => this.drawNow(1), PATIENCE);
  }

  drawNow(share) {
    const dense = Math.min(window.devicePixelRatio || 1, 2) * share;
    const { clientWidth, clientHeight } = this.canvas;
    const [width, height] = [clientWidth, clientHeight].map((x) => Math.max(Math.round(x * dense), 1));
    this.renderer.draw({ ...this.camera.view(width, height), time: this.player.time });
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { player, camera } = this, { tagName, type } = event.target;
    if (tagName === "SELECT" || (event.key === " " && (tagName === "BUTTON" || type === "checkbox"))) return; // theirs
    const actions = {
      " ": () => player.toggle(),
      ArrowLeft: () => player.seek(player.time - player.step),
      ArrowRight: () => player.seek(player.time + player.step),
      l: () => (player.loop.checked = !player.loop.checked),
      a: () => camera.turn(-0.1, 0),
      d: () => camera.turn(0.1, 0),
      w: () => camera.turn(0, 0.1),
      s: () => camera.turn(0, -0.1),
      "+": () => camera.zoom(0.9),
      "-": () => camera.zoom(1 / 0.9),
      r: () => camera.go(camera.index),
      c: () => camera.go(camera.index + 1),
      C: () => camera.go(camera.index - 1),
      f: () => fullScreen(),
      "?": () => this.help(),
    };
    if (!actions[event.key]) return;
    event.preventDefault();
    actions[event.key]();
    this.changed();
  }

  help() {
    const keys = document.getElementById("keys");
    keys.hidden = !keys.hidden;
  }

  // Draws exactly what is asked for and nothing else until `release`; the promise is kept once it is drawn.
  // view: { camFromWorld: 16 numbers row by row, intrinsics: [fx, fy, cx, cy] px, width, height, time }.
  async show(view) {
    this.asked = view;
    this.player.playing = false;
    this.player.time = view.time ?? this.player.time;
    this.player.show();
    const asked = { ...view, time: this.player.time };
    await this.renderer.arrived?.(asked);
    this.renderer.draw(asked);
    return this.image();
  }

  // The image as it is drawn now, a data: address of a PNG.
  image() {
    this.renderer.blendAll(); // browsers keep a canvas only until it is shown
    return this.canvas.toDataURL("image/png");
  }

  release() {
    this.asked = null;
    this.changed();
  }
}

function fullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.();
}

function rendererOf(canvas, scene, changed) {
  if (scene.segments) return new TriangleRenderer(canvas, scene);
  if (scene.levels) return new LevelRenderer(canvas, scene, changed);
  return new Renderer(canvas, scene, new Motion(scene));
}

// Shows a line, or hides it where it is empty.
function tell(line) {
  const message = document.getElementById("message");
  message.textContent = line;
  message.hidden = !line;
}

async function main() {
  try {
    const scene = await readScene();
    if (scene.levels && location.protocol === "file:")
      throw new Error("its parts are fetched, so open it by a web server, such as `python -m http.server`");
    const app = new App(scene);
    await app.renderer.begun?.(); // its first picture, however coarse
    app.drawNow(1);
    tell("");
    window.dyngs = app;
    if (app.scene.moves) app.player.toggle(true);
  } catch (error) {
    tell(`This scene cannot be shown: ${error.message}`);
    throw error;
  }
}

main();
