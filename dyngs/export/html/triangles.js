// Drawing curved triangles: one mesh of flat faces with a depth buffer, several samples a pixel, drawn twice as large.

class TriangleRenderer extends Drawing {
  constructor(canvas, scene) {
    super(canvas, scene);
    const { gl } = this, { lists, count, texture, degree } = scene;
    const colours = lists.colours.length / (3 * count);
    this.list("uPoints", inFours(lists.points), "32F");
    this.list("uColours", inFours(lists.colours), "16F");
    this.prepareHarmonics();
    this.faces = this.program("triangles.vert.glsl", "triangles.frag.glsl", null, {
      ROW, DEGREE: degree, HARMONIC_TEXELS: this.harmonicTexels, TEXTURE: texture, COLOURS: colours,
      WAVE_TEXELS: 0,
    });
    this.copy = this.program("copy.vert.glsl", "copy.frag.glsl");
    this.prepareMesh();
    this.samples = Math.min(gl.getParameter(gl.MAX_SAMPLES), 8);
    [this.fine, this.resolved] = [gl.createFramebuffer(), gl.createFramebuffer()];
    [this.colour, this.depth, this.image] = [gl.createRenderbuffer(), gl.createRenderbuffer(), gl.createTexture()];
  }

  prepareMesh() {
    const { gl, scene: { count, segments: n } } = this, places = [], faces = [];
    const index = (i, j) => ((n - i) * (n - i + 1)) / 2 + n - i - j;
    for (let i = n; i >= 0; --i) for (let j = n - i; j >= 0; --j) places.push(i / n, j / n);
    for (let i = 0; i < n; ++i)
      for (let j = 0; i + j < n; ++j) {
        faces.push(index(i, j), index(i + 1, j), index(i, j + 1));
        if (i + j + 2 <= n) faces.push(index(i + 1, j + 1), index(i, j + 1), index(i + 1, j));
      }
    const each = places.length / 2, vertices = new DataView(new ArrayBuffer(12 * each * count));
    const indices = new Uint32Array(faces.length * count);
    for (let p = 0; p < count; ++p) {
      for (let k = 0; k < each; ++k) {
        const at = 12 * (each * p + k);
        vertices.setFloat32(at, places[2 * k], true);
        vertices.setFloat32(at + 4, places[2 * k + 1], true);
        vertices.setUint32(at + 8, p, true);
      }
      for (let k = 0; k < faces.length; ++k) indices[faces.length * p + k] = each * p + faces[k];
    }
    this.mesh = gl.createVertexArray();
    this.corners = indices.length;
    gl.bindVertexArray(this.mesh);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, vertices.buffer, gl.STATIC_DRAW);
    const [place, triangle] = ["aPlace", "aTriangle"].map((name) => gl.getAttribLocation(this.faces.program, name));
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 2, gl.FLOAT, false, 12, 0);
    gl.enableVertexAttribArray(triangle);
    gl.vertexAttribIPointer(triangle, 1, gl.UNSIGNED_INT, 12, 8);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
  }

  resize(width, height) {
    const { gl, canvas } = this;
    if (width === this.size[0] && height === this.size[1]) return;
    this.size = [width, height];
    [canvas.width, canvas.height] = this.size;
    const times = 2 * Math.max(width, height) <= Math.min(this.limit, 8192) ? 2 : 1;
    this.drawn = [times * width, times * height];
    for (const [buffer, format] of [[this.colour, gl.RGBA8], [this.depth, gl.DEPTH_COMPONENT24]]) {
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorageMultisample(gl.RENDERBUFFER, this.samples, format, ...this.drawn);
    }
    gl.activeTexture(gl.TEXTURE0 + this.textures.length);
    gl.bindTexture(gl.TEXTURE_2D, this.image);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, ...this.drawn, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(gl.TEXTURE_2D, side, gl.LINEAR); // four pixels' mean in the middle between them
    for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, axis, gl.CLAMP_TO_EDGE);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.fine);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, this.colour);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, this.depth);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.resolved);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.image, 0);
  }

  // Draws from a camera: camFromWorld (16 numbers, row by row), intrinsics [fx, fy, cx, cy] px.
  draw({ camFromWorld: pose, intrinsics, width, height }) {
    this.resize(width, height);
    const { gl, scene, faces: { program, at } } = this, [low, high] = scene.bounds;
    gl.useProgram(program);
    for (const entry of this.textures) gl.uniform1i(at(entry.name), entry.unit);
    gl.uniformMatrix4fv(at("uCamFromWorld"), true, new Float32Array(pose));
    gl.uniform4fv(at("uIntrinsics"), intrinsics);
    gl.uniform2fv(at("uSize"), this.size);
    const eye = eyeOf(pose);
    gl.uniform3fv(at("uEye"), eye);
    const farthest = Math.hypot(...eye.map((x, k) => Math.max(Math.abs(x - low[k]), Math.abs(x - high[k]))));
    gl.uniform2f(at("uRange"), scene.near, Math.max(1.01 * farthest, 2 * scene.near));
    this.blendAll();
  }

  blendAll() {
    const { gl, drawn } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.fine);
    gl.viewport(0, 0, ...drawn);
    this.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(this.faces.program);
    gl.bindVertexArray(this.mesh);
    gl.drawElements(gl.TRIANGLES, this.corners, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
    gl.disable(gl.DEPTH_TEST);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.fine);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, this.resolved);
    gl.blitFramebuffer(0, 0, ...drawn, 0, 0, ...drawn, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, ...this.size);
    gl.useProgram(this.copy.program);
    gl.uniform1i(this.copy.at("uImage"), this.textures.length);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

// Rows of three numbers as rows of four.
function inFours(values) {
  const padded = new Float32Array((4 * values.length) / 3);
  for (let i = 0; i < values.length; ++i) padded[4 * Math.floor(i / 3) + (i % 3)] = values[i];
  return padded;
}
