// What all drawing with WebGL 2 needs: a context, programs, and lists of numbers in textures.

const ROW = 2048; // texels of a texture that holds a list

class Drawing {
  constructor(canvas, scene) {
    const gl = canvas.getContext("webgl2", {
      antialias: false, depth: false, alpha: scene.opacity < 1, powerPreference: "high-performance",
    });
    if (!gl) throw new Error("it needs WebGL 2, which this browser does not offer (is hardware acceleration off?)");
    Object.assign(this, { canvas, gl, scene, textures: [], size: [0, 0] });
    this.limit = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    this.harmonicTexels = Math.ceil((3 * ((scene.degree + 1) ** 2 - 1)) / 4);
  }

  // Fills the image with the background, premultiplied.
  clear(bits) {
    const { gl, scene: { background, opacity } } = this;
    gl.clearColor(...background.map((x) => x * opacity), opacity);
    gl.clear(bits);
  }

  // A program of the shaders here; `captured`: what transform feedback takes, with nothing drawn.
  program(vertex, fragment, captured, definitions = {}) {
    const { gl } = this, program = gl.createProgram();
    const lines = Object.entries(definitions).map(([name, value]) => `#define ${name} ${value}\n`).join("");
    const nothing = "#version 300 es\nprecision lowp float;\nout vec4 color;\nvoid main() { color = vec4(0.0); }";
    const texts = [SHADERS[vertex].trim(), fragment ? SHADERS[fragment].trim() : nothing];
    [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, i) => {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, texts[i].replace("#version 300 es\n", "#version 300 es\n" + lines)
        .replace('#include "harmonics.glsl"', () => SHADERS["harmonics.glsl"].trim()));
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS))
        throw new Error(`${i ? fragment : vertex}: ${gl.getShaderInfoLog(shader)}`);
      gl.attachShader(program, shader);
    });
    if (captured) gl.transformFeedbackVaryings(program, captured, gl.INTERLEAVED_ATTRIBS);
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS))
      throw new Error(`${vertex}: ${gl.getProgramInfoLog(program)}`);
    const places = {};
    return { program, at: (name) => (places[name] ??= gl.getUniformLocation(program, name)) };
  }

  // A list of four numbers each as a texture: "32F", "16F", or whole numbers, "16UI" and "32UI".
  list(name, values, kind) {
    const entry = this.reserve(name, values.length / 4, kind);
    entry.padded = new values.constructor(4 * ROW * entry.height);
    this.refill(entry, values);
    return entry;
  }

  // A texture for a list of so many texels.
  reserve(name, texels, kind) {
    const { gl } = this, height = Math.ceil(Math.max(Math.ceil(texels), 1) / ROW);
    if (height > this.limit) throw new Error(`this scene is too large for this device: ${this.scene.count} Gaussians`);
    const texture = gl.createTexture(), whole = kind.endsWith("UI"), format = whole ? gl.RGBA_INTEGER : gl.RGBA;
    const type = { "16UI": gl.UNSIGNED_SHORT, "32UI": gl.UNSIGNED_INT }[kind] || gl.FLOAT;
    const entry = { name, texture, unit: this.textures.length, height, format, type };
    this.textures.push(entry);
    gl.activeTexture(gl.TEXTURE0 + entry.unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    this.unfiltered();
    gl.texImage2D(gl.TEXTURE_2D, 0, gl["RGBA" + kind], ROW, height, 0, format, type, null);
    return entry;
  }

  unfiltered() {
    const { gl } = this;
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
  }

  refill(entry, values) {
    entry.padded.set(values);
    this.write(entry, 0, entry.padded);
  }

  // Writes whole rows of a texture, from a texel on.
  write(entry, texel, values) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + entry.unit);
    gl.texSubImage2D(
      gl.TEXTURE_2D, 0, 0, texel / ROW, ROW, values.length / (4 * ROW), entry.format, entry.type, values);
  }

  prepareHarmonics() {
    const { lists, count, degree } = this.scene;
    if (degree) this.list("uHarmonics", packedRows(lists.rest, count, this.harmonicTexels), "16F");
  }
}

// `count` rows of numbers, such as the other harmonics of Gaussians or triangles, in so many texels each.
function packedRows(values, count, texels) {
  const columns = values.length / count, width = 4 * texels;
  const packed = new Float32Array(width * count);
  for (let i = 0; i < count; ++i)
    for (let k = 0; k < columns; ++k) packed[width * i + k] = values[columns * i + k];
  return packed;
}

// Where a camera of camFromWorld stands.
function eyeOf(m) {
  return [0, 1, 2].map((k) => -(m[k] * m[3] + m[4 + k] * m[7] + m[8 + k] * m[11]));
}
