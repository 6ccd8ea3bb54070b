// A still scene in levels of detail, whose blocks are fetched when they are seen, the largest on the screen first.
// The tree, and what a camera needs of it, are those of dyngs/gaussians/levels.py.

class Tree {
  constructor({ levels, lists }) {
    const { sizes, block, merged } = levels;
    Object.assign(this, { merged, sizes, block, balls: lists.blocks, counts: sizes.map((n) => Math.ceil(n / block)) });
    this.first = []; // row of each level's first block
    this.counts.reduce((sum, n) => (this.first.push(sum), sum + n), 0);
    this.size = lists.blocks.length / 5;
    this.root = this.size - 1;
    const sound = sizes.every((n) => n > 0) && block > 0 && this.counts.reduce((sum, n) => sum + n, 0) === this.size;
    if (!sound) throw new Error("its levels are damaged");
  }

  levelOf(row) {
    return this.first.findLastIndex((first) => row >= first);
  }

  nameOf(row) {
    const level = this.levelOf(row);
    return `${level}-${row - this.first[level]}.bin`;
  }

  // Gaussians of a block.
  countOf(row) {
    const level = this.levelOf(row);
    return Math.min(this.block, this.sizes[level] - (row - this.first[level]) * this.block);
  }

  childrenOf(row) {
    const level = this.levelOf(row), { first, merged } = this;
    if (!level) return [];
    const from = merged * (row - first[level]), to = Math.min(from + merged, this.counts[level - 1]);
    return Array.from({ length: to - from }, (_, i) => first[level - 1] + from + i);
  }

  // Spread of a block on the screen where it is nearest, px; -1 outside.
  sizeOf(row, { camFromWorld: m, intrinsics: [fx, fy, cx, cy], width, height }) {
    const [x, y, z, radius, spread] = this.balls.subarray(5 * row, 5 * row + 5);
    const [u, v, w] = [0, 4, 8].map((k) => m[k] * x + m[k + 1] * y + m[k + 2] * z + m[k + 3]);
    if (w <= -radius) return -1;
    for (const [focal, middle, side, place] of [[fx, cx, width, u], [fy, cy, height, v]])
      for (const [slope, offset] of [[focal, middle], [-focal, side - middle]])
        if (slope * place + offset * w <= -radius * Math.hypot(slope, offset)) return -1;
    return (Math.max(fx, fy) * spread) / Math.max(Math.hypot(u, v, w) - radius, 1e-9);
  }

  // The blocks to draw, of those that are `here`, and those to fetch, the most important ones first.
  cut(view, here, most, pixels) {
    const cut = new Set([this.root]), wanted = [], waiting = [[this.sizeOf(this.root, view), this.root]];
    let drawn = this.countOf(this.root);
    while (waiting.length) {
      let best = 0;
      for (let i = 1; i < waiting.length; ++i) if (waiting[i][0] > waiting[best][0]) best = i;
      const [[size, row]] = waiting.splice(best, 1), children = this.childrenOf(row);
      const more = children.reduce((sum, child) => sum + this.countOf(child), -this.countOf(row));
      if (size <= pixels || !children.length || drawn + more > most) break;
      const missing = children.filter((child) => !here.has(child));
      drawn += more;
      if (missing.length) {
        wanted.push(...missing);
        continue;
      }
      cut.delete(row);
      for (const child of children) {
        cut.add(child);
        waiting.push([this.sizeOf(child, view), child]);
      }
    }
    return { cut, wanted };
  }
}

// What Renderer asks of a motion, of blocks in slots of `size` Gaussians each.
class Slots {
  constructor(count, size) {
    Object.assign(this, { count, size, moving: 0, means: new Float32Array(3 * count * size), changed: true });
    this.held = new Map(); // by block its slot; those used last are at the end
    this.drawn = new Set();
  }

  update() {
    const { changed } = this;
    this.changed = false;
    return changed;
  }

  has() {
    return true;
  }

  seen() {
    return null;
  }

  depths([x, y, z, w], out) {
    const { means, size } = this;
    out.fill(-1);
    for (const row of this.drawn) {
      const first = this.held.get(row) * size;
      for (let i = first; i < first + size; ++i)
        out[i] = x * means[3 * i] + y * means[3 * i + 1] + z * means[3 * i + 2] + w;
    }
  }

  show(cut) {
    this.changed ||= cut.size !== this.drawn.size || [...cut].some((row) => !this.drawn.has(row));
    this.drawn = cut;
    for (const row of cut) {
      const slot = this.held.get(row);
      this.held.delete(row);
      this.held.set(row, slot);
    }
  }

  // A slot for a block: a free one, or that of the block that was not drawn for the longest time; -1: there is none.
  take(row, kept) {
    let slot = this.held.size;
    if (slot >= this.count) {
      const old = [...this.held.keys()].find((one) => !this.drawn.has(one) && one !== kept);
      if (old === undefined) return -1;
      slot = this.held.get(old);
      this.held.delete(old);
    }
    this.held.set(row, slot);
    return slot;
  }
}

class LevelRenderer extends Renderer {
  constructor(canvas, scene, source, changed) {
    const tree = new Tree(scene), probe = new OffscreenCanvas(1, 1).getContext("webgl2");
    const limit = probe ? probe.getParameter(probe.MAX_TEXTURE_SIZE) : 2048;
    probe?.getExtension("WEBGL_lose_context")?.loseContext(); // browsers keep few
    const texels = Math.max(4, Math.ceil((3 * ((scene.degree + 1) ** 2 - 1)) / 4));
    const slots = Math.min(tree.size, Math.floor((limit * ROW) / (texels * tree.block)));
    super(canvas, { ...scene, count: slots * tree.block }, new Slots(slots, tree.block));
    this.tree = tree;
    this.rows = new Map(Array.from({ length: tree.size }, (_, row) => [tree.nameOf(row), row]));
    this.parts = new Parts(source, (name, blob) => this.fill(this.rows.get(name), blob), changed);
    // Where not all blocks have a slot, some are left for those that arrive.
    const room = slots === tree.size ? Infinity : Math.max(slots - 4 * tree.merged, 1) * tree.block;
    this.most = Math.min(scene.levels.most ?? Infinity, room);
  }

  prepareLists() {
    const { count, degree } = this.scene;
    this.gaussians = this.reserve("uGaussians", 4 * count, "32F");
    if (degree) this.harmonics = this.reserve("uHarmonics", this.harmonicTexels * count, "16F");
  }

  // Returns once the coarsest block is here.
  async begun() {
    const { tree, motion, parts } = this;
    for (; !motion.held.has(tree.root) && !parts.signal.aborted; await aMoment()) parts.want([tree.nameOf(tree.root)]);
  }

  // Returns once all is here that a view needs.
  async arrived(view) {
    while (this.choose(view)) await aMoment();
  }

  draw(view) {
    this.choose(view);
    if (this.motion.drawn.size) super.draw(view);
  }

  // Chooses what is drawn, asks for what is to be drawn, and returns how many blocks are missing.
  choose(view) {
    const { tree, motion, scene } = this;
    if (!motion.held.has(tree.root)) return 1;
    const { cut, wanted } = tree.cut(view, motion.held, this.most, scene.levels.pixels);
    motion.show(cut);
    this.parts.want(wanted.map((row) => tree.nameOf(row)));
    return wanted.length;
  }

  async fill(row, blob) {
    const { layout, block } = this.scene.levels, { degree } = this.scene, lists = await listsOf(layout, blob);
    const slot = this.motion.take(row, this.tree.root);
    if (slot < 0) return;
    this.motion.means.set(lists.means, 3 * block * slot);
    this.write(this.gaussians, 4 * block * slot, packedGaussians(lists, block));
    const texels = this.harmonicTexels;
    if (degree) this.write(this.harmonics, texels * block * slot, packedRows(lists.rest, block, texels));
  }
}
