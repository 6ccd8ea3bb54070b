// <dyngs-scene src="town/">: a scene in any page, which it draws whenever something has changed. `src` is a page that
// `dyngs export --format html` wrote, or its folder; in such a page itself, the element holds the scene.

const SLOW = 50; // ms for a frame, from which on fewer pixels are drawn while things move
const COARSEST = 0.35;
const PATIENCE = 250; // ms without a change until all pixels are drawn again

class DyngsScene extends HTMLElement {
  static observedAttributes = ["src", "background"];

  constructor() {
    super();
    this.root = this.attachShadow({ mode: "open" });
    this.observers = [
      new ResizeObserver(() => this.changed()),
      new IntersectionObserver(([{ isIntersecting }]) => this.seen(isIntersecting), { rootMargin: "50%" }),
    ];
    this.heard = (event) => this.key(event);
  }

  connectedCallback() {
    for (const observer of this.observers) observer.observe(this);
    this.embedded = !this.querySelector(":scope > #header");
    this.keyboard = this.embedded ? this : document;
    this.keyboard.addEventListener("keydown", this.heard);
    if (!this.started) this.parts = controlsIn(this.root);
  }

  disconnectedCallback() {
    for (const observer of this.observers) observer.disconnect();
    this.keyboard.removeEventListener("keydown", this.heard);
    this.end();
    this.inView = false;
  }

  attributeChangedCallback() {
    if (this.started && this.embedded) this.load();
  }

  // A scene is loaded once it comes near what is seen of the page, and rests while it is not.
  seen(inView) {
    this.inView = inView;
    if (inView && !this.started) this.load();
    else if (inView) this.changed();
  }

  // Gives back what was loaded, with the memory of the GPU.
  end() {
    this.started?.abort(new Error("not wanted any more"));
    clearTimeout(this.refining);
    this.renderer?.gl.getExtension("WEBGL_lose_context")?.loseContext();
    Object.assign(this, { started: null, scene: null, renderer: null, camera: null, player: null, asked: null });
  }

  async load() {
    this.end();
    const { signal } = (this.started = new AbortController());
    this.parts = controlsIn(this.root);
    this.tell("Reading the scene …");
    try {
      const { texts, base } = await this.texts(signal);
      const scene = await sceneOf(texts);
      if (signal.aborted) return;
      await this.begin({ ...scene, ...this.backgroundOf(scene) }, { base, signal, tell: (line) => this.tell(line) });
      if (signal.aborted) return;
      this.tell("");
      this.dispatchEvent(new Event("load"));
    } catch (error) {
      if (signal.aborted) return;
      this.tell(`${this.getAttribute("src") || "This scene"} cannot be shown: ${error.message}`);
      this.dispatchEvent(new ErrorEvent("error", { message: error.message, error }));
      if (!this.embedded) throw error;
    }
  }

  // The texts of a scene, and the address to which those of its parts are relative.
  async texts(signal) {
    if (this.embedded) {
      if (!this.getAttribute("src")) throw new Error('its element has no src="PAGE"');
      const address = new URL(this.getAttribute("src"), document.baseURI);
      if (!/^https?:$/.test(address.protocol))
        throw new Error("it is fetched, so open this page by a web server, such as `python -m http.server`");
      const page = await insisted(address, signal, (line) => this.tell(line));
      return { texts: textsOf(await page.blob.text()), base: page.address };
    }
    const [header, numbers] = PLACES.map((name) => this.querySelector(`#${name}`));
    const texts = [header.textContent, numbers.textContent];
    numbers.remove();
    return { texts, base: location.href };
  }

  // What the attribute says, or the scene.
  backgroundOf({ background }) {
    const asked = this.getAttribute("background");
    if (asked === null) return { background, opacity: 1 };
    if (!CSS.supports("color", asked) || /^(inherit|initial|unset|revert.*|currentcolor)$/i.test(asked.trim()))
      throw new Error(`background="${asked}" is no colour`);
    const pixel = new OffscreenCanvas(1, 1).getContext("2d");
    pixel.fillStyle = asked;
    pixel.fillRect(0, 0, 1, 1);
    const [red, green, blue, opacity] = pixel.getImageData(0, 0, 1, 1).data.map(Number);
    return { background: [red, green, blue].map((x) => x / 255), opacity: opacity / 255 };
  }

  async begin(scene, source) {
    if ((scene.levels || scene.curves?.chunk) && location.protocol === "file:")
      throw new Error("its parts are fetched, so open it by a web server, such as `python -m http.server`");
    const { canvas, help, keys, next } = this.parts, changed = () => this.changed();
    const renderer = rendererOf(canvas, scene, source, changed);
    await renderer.begun?.(); // its first picture, however coarse
    if (source.signal.aborted) return;
    Object.assign(this, { scene, canvas, renderer, camera: new OrbitCamera(scene), asked: null });
    this.player = new Player(scene, this.parts, changed);
    Object.assign(this, { coarse: 1, frames: 0, wanted: false, running: false }); // coarse: share of the pixels' sides
    canvas.setAttribute("aria-label", this.getAttribute("aria-label") ?? (this.title || "A scene"));
    // In the middle of an article, the wheel is for the article until the scene is clicked.
    steer(canvas, this.camera, changed, () => !this.embedded || this.root.activeElement !== null);
    help.addEventListener("click", () => this.help());
    keys.firstChild.replaceChildren(...keysOf(scene));
    next.hidden = scene.views.length < 2;
    next.addEventListener("click", () => this.go(1));
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      if (!source.signal.aborted) this.tell("The browser has stopped drawing this scene; click it to go on.");
    });
    const again = () => (this.embedded ? this.load() : location.reload());
    canvas.addEventListener("webglcontextrestored", again);
    canvas.addEventListener("pointerdown", () => renderer.gl.isContextLost() && again());
    this.drawNow(1);
    if (!this.embedded) window.dyngs = this;
    if (this.hasAttribute("autoplay") && !matchMedia("(prefers-reduced-motion: reduce)").matches) this.play();
  }

  // Shows a line, or hides it where it is empty: in the middle until there is a picture.
  tell(line) {
    const { message } = this.parts;
    message.textContent = line;
    message.hidden = !line;
    message.classList.toggle("aside", Boolean(this.renderer));
  }

  play() {
    this.player?.toggle(true);
  }

  pause() {
    this.player?.toggle(false);
  }

  changed() {
    clearTimeout(this.refining);
    this.request();
  }

  request() {
    if (this.wanted || !this.renderer) return;
    this.wanted = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.wanted = false;
    if (this.asked || !this.renderer || !this.inView) {
      this.running = false; // a script says what is drawn, or nobody sees it
      return;
    }
    const since = now - (this.last ?? -1e9);
    this.last = now;
    if (this.running && !this.renderer.waits?.(this.player.time)) this.player.advance(Math.min(since, 1000) / 1000);
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
    if (!this.renderer || event.ctrlKey || event.metaKey || event.altKey) return;
    const { player, camera } = this, { tagName, type } = event.composedPath()[0];
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
      r: () => this.go(0),
      c: () => this.go(1),
      C: () => this.go(-1),
      f: () => (document.fullscreenElement ? document.exitFullscreen() : this.requestFullscreen?.()),
      "?": () => this.help(),
    };
    if (!actions[event.key]) return;
    event.preventDefault();
    actions[event.key]();
    this.changed();
  }

  // Moves to the camera of the capture that is `by` places on.
  go(by) {
    this.camera.go(this.camera.index + by);
    this.changed();
  }

  help() {
    const { keys } = this.parts;
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

function rendererOf(canvas, scene, source, changed) {
  if (scene.segments) return new TriangleRenderer(canvas, scene);
  if (scene.levels) return new LevelRenderer(canvas, scene, source, changed);
  return new Renderer(canvas, scene, new Motion(scene, scene.curves?.chunk && new Chunks(scene, source, changed)));
}

if (!customElements.get("dyngs-scene")) customElements.define("dyngs-scene", DyngsScene);
