// Drawing with WebGL 2: project.glsl computes every Gaussian once, splat.*.glsl blends their squares far to near.

const BATCH = 16384; // squares of one call: their corners are numbered by 16 bits
const CORNERS = [0, 1, 2, 3].flatMap((k) => [`vCorner${k}`, `vColor${k}`]);
const CORNER_BYTES = 32;

class Renderer extends Drawing {
  constructor(canvas, scene, motion) {
    super(canvas, scene);
    const { gl } = this;
    this.motion = motion;
    // Eight bits are few for hundreds of layers: blended in half floats where they can be drawn to.
    this.deep = Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
    this.order = new DepthOrder(scene.count);
    // texels of a cosine of all harmonics of a Gaussian
    this.waveTexels = scene.lines && scene.lines.waves ? Math.ceil((3 * (scene.degree + 1) ** 2) / 4) : 0;
    this.prepareLists();
    this.project = this.program("project.glsl", null, CORNERS, this.definitions());
    this.splat = this.program("splat.vert.glsl", "splat.frag.glsl");
    this.copy = this.program("copy.vert.glsl", "copy.frag.glsl");
    this.prepareBuffers();
    this.view = null;
  }

  definitions() {
    const { scene, motion } = this, network = scene.network;
    return {
      ROW,
      DEGREE: scene.degree,
      HARMONIC_TEXELS: this.harmonicTexels,
      MOVING: motion.moving,
      LINES: scene.lines ? scene.lines.moving : 0,
      WAVES: scene.lines ? scene.lines.waves : 0,
      WAVE_TEXELS: this.waveTexels,
      WINDOWED: motion.windows ? 1 : 0,
      EDGE: motion.windows ? scene.curves.edge.toFixed(6) : 1,
      OPEN: motion.windows ? scene.curves.open.map((x) => x.toFixed(6)).join(", ") : 0,
      BONES: motion.bones ? 1 : 0,
      FILTERED: scene.filtered ? 1 : 0,
      LAYERS: network ? network.layers : 0,
      WIDTH: network ? network.width : 0,
      FIRST: network ? network.first : 0,
      SEES_NORMALS: network && network.normals ? 1 : 0,
      SEES_TIME: network && network.time ? 1 : 0,
    };
  }

  prepareLists() {
    const { scene, motion } = this, { lists, count } = scene;
    this.list("uGaussians", packedGaussians(lists, count), "32F");
    this.prepareHarmonics();
    if (motion.drivers) this.prepareDrivers();
    if (scene.lines) this.prepareLines();
    if (motion.bones) {
      this.bones = this.list("uBones", motion.bones.values, "32F");
      this.list("uBoned", motion.boned, "16UI");
      this.list("uBonedShares", motion.bonedShares, "32F");
    }
    if (scene.network) this.list("uNetwork", lists.network, "32F");
  }

  prepareDrivers() {
    const { motion } = this;
    this.drivers = this.list("uDrivers", motion.drivers.values, "32F");
    if (motion.perGaussian === 1) {
      const own = new Uint32Array(4 * motion.moving), ones = new Float32Array(4 * motion.moving);
      for (let i = 0; i < motion.moving; ++i) {
        own[4 * i] = i;
        ones[4 * i] = 1;
      }
      this.list("uDriven", own, "32UI");
      this.list("uDrivenShares", ones, "32F");
    } else {
      this.list("uDriven", motion.followed, "16UI");
      this.list("uDrivenShares", motion.shares, "32F");
    }
    if (motion.windows) this.list("uWindows", motion.windows, "32F");
  }

  prepareLines() {
    const { lines, lists } = this.scene;
    this.list("uLines", packedRows(lists.lines, lines.moving, 2), "32F");
    if (lines.waves) this.list("uWaves", packedRows(lists.waves, lines.waves * lines.moving, this.waveTexels), "16F");
  }

  prepareBuffers() {
    const { gl, scene } = this;
    this.indices = gl.createBuffer();
    this.projected = gl.createBuffer();
    this.reading = gl.createVertexArray();
    this.drawing = gl.createVertexArray();
    this.feedback = gl.createTransformFeedback();
    gl.bindVertexArray(this.reading);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ARRAY_BUFFER, 4 * scene.count, gl.DYNAMIC_DRAW);
    const index = gl.getAttribLocation(this.project.program, "aIndex");
    gl.enableVertexAttribArray(index);
    gl.vertexAttribIPointer(index, 1, gl.UNSIGNED_INT, 4, 0);
    // Not drawn as instances of one square: some drivers make a call of each.
    gl.bindBuffer(gl.ARRAY_BUFFER, this.projected);
    gl.bufferData(gl.ARRAY_BUFFER, 4 * CORNER_BYTES * scene.count, gl.DYNAMIC_COPY);
    this.cornerPlaces = ["aCorner", "aColor"].map((name) => gl.getAttribLocation(this.splat.program, name));
    gl.bindVertexArray(this.drawing);
    for (const place of this.cornerPlaces) gl.enableVertexAttribArray(place);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    const corners = new Uint16Array(6 * BATCH);
    for (let i = 0; i < BATCH; ++i) corners.set([0, 1, 2, 2, 1, 3].map((k) => 4 * i + k), 6 * i);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    gl.bindBuffer(gl.ARRAY_BUFFER, null);
    gl.disable(gl.DEPTH_TEST);
    if (this.deep) {
      this.image = gl.createTexture();
      this.target = gl.createFramebuffer();
    }
  }

  resize(width, height) {
    const { gl, canvas } = this;
    if (width === this.size[0] && height === this.size[1]) return;
    this.size = [width, height];
    canvas.width = width;
    canvas.height = height;
    if (!this.deep) return;
    gl.activeTexture(gl.TEXTURE0 + this.textures.length);
    gl.bindTexture(gl.TEXTURE_2D, this.image);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.HALF_FLOAT, null);
    this.unfiltered();
    for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, axis, gl.CLAMP_TO_EDGE);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.image, 0);
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) this.deep = false;
  }

  // Returns once its first picture can be drawn, or that of a view.
  async begun() {
    await this.arrived({ time: this.scene.time || 0 });
  }

  async arrived({ time }) {
    while (this.waits(time) && !this.motion.drivers.chunks.parts.signal.aborted) await aMoment();
  }

  // Whether a time cannot be drawn yet.
  waits(time) {
    return !this.motion.has(time);
  }

  // Draws the scene at `time` from a camera: camFromWorld (16 numbers, row by row), intrinsics [fx, fy, cx, cy] px.
  draw({ camFromWorld, intrinsics, width, height, time }) {
    const { gl, scene, motion, order } = this;
    this.resize(width, height);
    const moved = motion.update(time);
    if (moved && this.drivers) this.refill(this.drivers, motion.drivers.values);
    if (moved && this.bones) this.refill(this.bones, motion.bones.values);
    const axis = Array.from(camFromWorld.slice(8, 12));
    if (moved || !this.axis || axis.some((x, i) => x !== this.axis[i])) {
      this.axis = axis;
      motion.depths(axis, order.depths);
      this.kept = order.sort(scene.near, motion.seen());
      gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, order.order, 0, this.kept);
      gl.bindBuffer(gl.ARRAY_BUFFER, null);
    }
    this.projectAll(camFromWorld, intrinsics, time);
    this.blendAll();
  }

  projectAll(pose, intrinsics, time) {
    const { gl, scene, motion, project } = this, { at } = project;
    gl.useProgram(project.program);
    for (const entry of this.textures) gl.uniform1i(at(entry.name), entry.unit);
    gl.uniformMatrix4fv(at("uCamFromWorld"), true, new Float32Array(pose));
    gl.uniform4fv(at("uIntrinsics"), intrinsics);
    gl.uniform2fv(at("uSize"), this.size);
    gl.uniform3fv(at("uEye"), eyeOf(pose));
    gl.uniform4f(at("uLimits"), scene.eps2d, scene.near, scene.alphaMin, scene.antialiased ? 1 : 0);
    gl.uniform1f(at("uTime"), time);
    if (motion.bones) {
      gl.uniform4fv(at("uBody"), motion.bones.body);
      gl.uniformMatrix3fv(at("uTurn"), true, new Float32Array(motion.bones.rootTurn));
    }
    if (scene.network) gl.uniform3fv(at("uBox[0]"), scene.network.box);
    gl.bindVertexArray(this.reading);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, this.feedback);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, this.projected);
    gl.enable(gl.RASTERIZER_DISCARD);
    gl.beginTransformFeedback(gl.POINTS);
    gl.drawArrays(gl.POINTS, 0, this.kept);
    gl.endTransformFeedback();
    gl.disable(gl.RASTERIZER_DISCARD);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, null);
  }

  blendAll() {
    const { gl, scene } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.deep ? this.target : null);
    gl.viewport(0, 0, ...this.size);
    this.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(this.splat.program);
    gl.uniform1f(this.splat.at("uLeast"), scene.alphaMin);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.drawing);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.projected);
    for (let first = 0; first < this.kept; first += BATCH) {
      this.cornerPlaces.forEach((place, i) =>
        gl.vertexAttribPointer(place, 4, gl.FLOAT, false, CORNER_BYTES, 4 * CORNER_BYTES * first + 16 * i));
      gl.drawElements(gl.TRIANGLES, 6 * Math.min(BATCH, this.kept - first), gl.UNSIGNED_SHORT, 0);
    }
    gl.disable(gl.BLEND);
    gl.bindBuffer(gl.ARRAY_BUFFER, null);
    gl.bindVertexArray(null);
    if (!this.deep) return;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.copy.program);
    gl.uniform1i(this.copy.at("uImage"), this.textures.length);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

// `count` Gaussians, 16 numbers each, see project.glsl.
function packedGaussians(lists, count) {
  const packed = new Float32Array(16 * count);
  for (let i = 0; i < count; ++i) {
    const at = 16 * i;
    for (let k = 0; k < 3; ++k) {
      packed[at + k] = lists.means[3 * i + k];
      packed[at + 8 + k] = lists.log_scales[3 * i + k];
      packed[at + 12 + k] = lists.base[3 * i + k];
    }
    packed[at + 3] = lists.logit_opacities[i];
    packed[at + 11] = lists.filter_std ? lists.filter_std[i] : 0;
    for (let k = 0; k < 4; ++k) packed[at + 4 + k] = lists.quats[4 * i + k];
  }
  return packed;
}
