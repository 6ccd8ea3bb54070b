// A camera that circles a point: its place by angles about the scene's up direction, and what moves it.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, share = 1) => a.map((x, i) => x + share * b[i]);
const unit = (a) => a.map((x) => x / (Math.hypot(...a) || 1));

const STEEPEST = (89 * Math.PI) / 180;

class OrbitCamera {
  constructor(scene) {
    this.up = unit(scene.up);
    const side = Math.abs(this.up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
    this.east = unit(cross(side, this.up));
    this.north = cross(this.up, this.east);
    this.scene = scene;
    this.go(0);
  }

  // Stands where a camera of the capture stood, level, turning about what lies in its middle.
  go(index) {
    const { views, target } = this.scene;
    this.index = ((index % views.length) + views.length) % views.length;
    const { camFromWorld: m, intrinsics, width, height } = views[this.index];
    const eye = eyeOf(m);
    const forward = [m[8], m[9], m[10]];
    const away = plus(target, eye, -1);
    this.reach = this.distance = Math.max(dot(away, forward), 0.05 * Math.hypot(...away)) || 1;
    this.target = plus(eye, forward, this.distance);
    this.pitch = Math.asin(Math.min(Math.max(-dot(forward, this.up), -1), 1));
    this.yaw = Math.atan2(-dot(forward, this.north), -dot(forward, this.east));
    this.pitch = Math.min(Math.max(this.pitch, -STEEPEST), STEEPEST);
    this.frame = { intrinsics, width, height };
  }

  get toEye() {
    const level = plus(this.east.map((x) => x * Math.cos(this.yaw)), this.north, Math.sin(this.yaw));
    return plus(level.map((x) => x * Math.cos(this.pitch)), this.up, Math.sin(this.pitch));
  }

  get axes() {
    const forward = this.toEye.map((x) => -x);
    const right = unit(cross(forward, this.up));
    return [right, cross(forward, right), forward];
  }

  turn(x, y) {
    this.yaw -= x;
    this.pitch = Math.min(Math.max(this.pitch + y, -STEEPEST), STEEPEST);
  }

  // Moves the scene by fractions of the image's height.
  shift(x, y) {
    const [right, down] = this.axes, reach = (this.distance * this.frame.height) / this.frame.intrinsics[1];
    this.target = plus(plus(this.target, right, -x * reach), down, -y * reach);
  }

  zoom(factor) {
    this.distance = Math.min(Math.max(this.distance * factor, 1e-6 * this.reach), 1e6 * this.reach);
  }

  // The view into a canvas of `width` x `height`: the image of the capture fits into it.
  view(width, height) {
    const { intrinsics: [fx, fy, cx, cy], width: w, height: h } = this.frame;
    const scale = Math.min(width / w, height / h);
    const eye = plus(this.target, this.toEye, this.distance);
    const rows = this.axes.map((axis) => [...axis, -dot(axis, eye)]);
    return {
      camFromWorld: [...rows.flat(), 0, 0, 0, 1],
      intrinsics: [scale * fx, scale * fy, width / 2 + scale * (cx - w / 2), height / 2 + scale * (cy - h / 2)],
      width,
      height,
    };
  }
}

// Mouse, touch and wheel: one finger turns, two shift and zoom; so does the right button, and the wheel.
// `wheels()`: whether the wheel is for the scene now.
function steer(element, camera, changed, wheels) {
  const fingers = new Map();
  const middle = () => {
    const places = [...fingers.values()];
    const [x, y] = [0, 1].map((k) => places.reduce((sum, p) => sum + p[k], 0) / places.length);
    const apart = places.length > 1 ? Math.hypot(places[0][0] - places[1][0], places[0][1] - places[1][1]) : 0;
    return { x, y, apart };
  };
  element.addEventListener("pointerdown", (event) => {
    element.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  element.addEventListener("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const before = middle();
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    const after = middle(), side = element.clientHeight || 1;
    const [x, y] = [(after.x - before.x) / side, (after.y - before.y) / side];
    if (fingers.size > 1 || event.shiftKey || event.buttons & 6) camera.shift(x, y);
    else camera.turn(3 * x, 3 * y);
    if (before.apart > 0 && after.apart > 0) camera.zoom(before.apart / after.apart);
    changed();
  });
  for (const name of ["pointerup", "pointercancel"])
    element.addEventListener(name, (event) => fingers.delete(event.pointerId));
  element.addEventListener("contextmenu", (event) => event.preventDefault());
  element.addEventListener("wheel", (event) => {
    if (!wheels()) return;
    event.preventDefault();
    camera.zoom(Math.exp(Math.min(Math.max(event.deltaY, -200), 200) / 600));
    changed();
  }, { passive: false });
}
