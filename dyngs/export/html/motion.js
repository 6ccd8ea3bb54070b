// Where Gaussians are at a time. Those that move follow drivers: control nodes (each Gaussian blends those near it),
// or one of their own; then, on a person, the bones of a body. A driver is an affine map for places, and changes of
// all else.

// Values at `x` of a piece of uniform cubic B-splines: `curves` has `points` control points of `size` values for each
// of `count`.
function splinesAt(curves, count, points, size, piece, x, values) {
  const y = 1 - x;
  const a = y ** 3 / 6, b = (3 * x ** 3 - 6 * x * x + 4) / 6, c = (3 * y ** 3 - 6 * y * y + 4) / 6, d = x ** 3 / 6;
  for (let i = 0; i < count; ++i) {
    const first = (i * points + piece) * size;
    for (let k = 0; k < size; ++k) {
      const p = first + k;
      values[i * size + k] =
        a * curves[p] + b * curves[p + size] + c * curves[p + 2 * size] + d * curves[p + 3 * size];
    }
  }
}

// The 3x3 rotation, row by row, of a quaternion wxyz of any length.
function rotationOf(q, at, out) {
  const size = Math.hypot(q[at], q[at + 1], q[at + 2], q[at + 3]);
  const [w, x, y, z] = size > 0 ? [q[at] / size, q[at + 1] / size, q[at + 2] / size, q[at + 3] / size] : [1, 0, 0, 0];
  out[0] = 1 - 2 * (y * y + z * z); out[1] = 2 * (x * y - w * z); out[2] = 2 * (x * z + w * y);
  out[3] = 2 * (x * y + w * z); out[4] = 1 - 2 * (x * x + z * z); out[5] = 2 * (y * z - w * x);
  out[6] = 2 * (x * z - w * y); out[7] = 2 * (y * z + w * x); out[8] = 1 - 2 * (x * x + y * y);
  return out;
}

const HEADS = [["means", 3, 0], ["quats", 4, 12], ["log_scales", 3, 16], ["logit_opacities", 1, 19], ["colors", 3, 20]];

// Drivers at a time, 24 numbers each: three rows of the affine map, the quaternion, log scales and logit, the colour.
class Drivers {
  constructor(scene, chunks) {
    const { curves, lists } = scene;
    this.count = curves.count;
    this.pieces = curves.points - 3;
    this.chunk = curves.chunk ?? this.pieces; // pieces of a chunk of time
    Object.assign(this, { lists, chunks });
    this.pivots = lists.pivots; // absent where each Gaussian has a driver of its own, which turns it about itself
    this.heads = HEADS.map(([name, size, at]) => ({ name: "curve_" + name, size, at }))
      .filter(({ name }) => (curves.layout ?? lists)[name])
      .map((head) => ({ ...head, now: new Float32Array(curves.count * head.size) }));
    this.values = new Float32Array(24 * this.count);
    this.turn = new Float64Array(9);
  }

  // The piece of the splines at a time, the place in it, and the lists that hold it: none while they are fetched.
  at(time) {
    const { pieces, chunk } = this, place = Math.min(Math.max(time, 0), 1) * pieces;
    const piece = Math.min(Math.floor(place), pieces - 1), number = Math.floor(piece / chunk);
    const lists = this.chunks ? this.chunks.at(number) : this.lists;
    return { piece: piece - number * chunk, x: place - piece, lists };
  }

  update(time) {
    const { values, pivots, turn } = this, { piece, x, lists } = this.at(time);
    if (!lists) return false;
    values.fill(0);
    for (const { name, size, now } of this.heads)
      splinesAt(lists[name], this.count, this.chunk + 3, size, piece, x, now);
    for (let i = 0; i < this.count; ++i) {
      const at = 24 * i;
      values[at + 12] = 1;
      for (const head of this.heads.slice(1))
        for (let k = 0; k < head.size; ++k) values[at + head.at + k] += head.now[head.size * i + k];
      const shift = this.heads[0].now;
      if (pivots) rotationOf(values, at + 12, turn);
      for (let row = 0; row < 3; ++row) {
        for (let k = 0; k < 3; ++k) values[at + 4 * row + k] = pivots ? turn[3 * row + k] : +(row === k);
        let moved = shift[3 * i + row];
        if (pivots) {
          moved += pivots[3 * i + row];
          for (let k = 0; k < 3; ++k) moved -= turn[3 * row + k] * pivots[3 * i + k];
        }
        values[at + 4 * row + 3] = moved;
      }
    }
    return true;
  }
}

function slerp(q, a, b, share, out) {
  let cosine = q[a] * q[b] + q[a + 1] * q[b + 1] + q[a + 2] * q[b + 2] + q[a + 3] * q[b + 3];
  const sign = cosine < 0 ? -1 : 1;
  cosine = Math.min(cosine * sign, 1);
  const angle = Math.acos(cosine), sine = Math.sin(angle);
  const u = sine > 1e-6 ? Math.sin((1 - share) * angle) / sine : 1 - share;
  const v = sign * (sine > 1e-6 ? Math.sin(share * angle) / sine : share);
  for (let k = 0; k < 4; ++k) out[k] = u * q[a + k] + v * q[b + k];
  return out;
}

// A skeleton's bones at a time, 12 numbers each: three rows of the affine map from rest, m. See pose/skinning.py.
class Bones {
  constructor(scene) {
    const { lists } = scene;
    this.parents = scene.bones.parents;
    this.joints = lists.joints;
    this.times = lists.clip_times;
    this.poses = lists.clip_quats; // (frames, joints, 4)
    this.places = lists.clip_places; // (frames, 4): translation and scale
    this.values = new Float32Array(12 * this.parents.length);
    this.body = new Float32Array(4);
    this.rootTurn = new Float64Array(9);
  }

  update(time) {
    const { times, poses, places, parents, joints, values } = this;
    const count = parents.length, last = times.length - 1;
    const moment = Math.min(Math.max(time, times[0]), times[last]);
    let after = times.findIndex((t) => t >= moment - 1e-7);
    if (after < 0) after = last;
    const before = Math.max(after - 1, 0);
    const apart = times[after] - times[before];
    const share = apart > 0 ? Math.min(Math.max((moment - times[before]) / apart, 0), 1) : 0;
    for (let k = 0; k < 4; ++k) this.body[k] = (1 - share) * places[4 * before + k] + share * places[4 * after + k];
    const turn = new Float64Array(9), quat = new Float64Array(4), own = new Float64Array(12);
    for (let j = 0; j < count; ++j) {
      slerp(poses, 4 * (before * count + j), 4 * (after * count + j), share, quat);
      rotationOf(quat, 0, turn);
      if (j === 0) this.rootTurn.set(turn);
      for (let row = 0; row < 3; ++row) {
        let shift = joints[3 * j + row];
        for (let k = 0; k < 3; ++k) {
          own[4 * row + k] = turn[3 * row + k];
          shift -= turn[3 * row + k] * joints[3 * j + k];
        }
        own[4 * row + 3] = shift;
      }
      const at = 12 * j, above = 12 * parents[j];
      for (let row = 0; row < 3; ++row)
        for (let column = 0; column < 4; ++column) {
          let sum = parents[j] < 0 ? own[4 * row + column] : column === 3 ? values[above + 4 * row + 3] : 0;
          if (parents[j] >= 0)
            for (let k = 0; k < 3; ++k) sum += values[above + 4 * row + k] * own[4 * k + column];
          values[at + 4 * row + column] = sum;
        }
    }
  }
}

// Fractions of 8 bits as floats whose sums, `count` of them each, are 1.
function wholeShares(bytes, count) {
  const shares = Float32Array.from(bytes);
  for (let i = 0; i < shares.length; i += count) {
    let sum = 0;
    for (let k = i; k < i + count; ++k) sum += shares[k];
    for (let k = i; k < i + count; ++k) shares[k] = sum > 0 ? shares[k] / sum : +(k === i);
  }
  return shares;
}

// All that moves, and how far from a camera it is.
class Motion {
  constructor(scene, chunks) {
    const { lists } = scene;
    this.count = scene.count;
    this.moving = scene.curves ? scene.curves.moving : 0;
    this.drivers = scene.curves ? new Drivers(scene, chunks) : null;
    this.bones = scene.bones ? new Bones(scene) : null;
    this.means = lists.means;
    this.lines = scene.lines && { ...scene.lines, list: lists.lines };
    this.windows = lists.windows; // when each Gaussian that moves is there: from, to
    this.masks = scene.masks ? { times: scene.masks.times, bits: lists.masks, bytes: Math.ceil(this.count / 8) } : null;
    if (this.drivers) {
      this.perGaussian = lists.followed ? lists.followed.length / this.moving : 1;
      const own = Uint32Array.from({ length: this.moving }, (_, i) => i);
      this.followed = lists.followed || own;
      this.shares = lists.followed ? wholeShares(lists.shares, this.perGaussian) : new Float32Array(own.length).fill(1);
    }
    this.boned = lists.boned;
    this.bonedShares = this.bones ? wholeShares(lists.boned_shares, 8) : null;
    this.time = NaN;
  }

  get moves() {
    return Boolean(this.drivers || this.bones || this.lines);
  }

  // Whether all is here that it needs at a time.
  has(time) {
    return time === this.time || !this.drivers || Boolean(this.drivers.at(time).lists);
  }

  // Returns whether anything has moved: not while what it needs is fetched.
  update(time) {
    if (time === this.time || (this.drivers && !this.drivers.update(time))) return false;
    this.time = time;
    if (this.bones) this.bones.update(time);
    return true;
  }

  // Which Gaussians are seen around the time, as bytes of eight; null: all may be.
  seen() {
    if (!this.masks) return null;
    const { times, bits, bytes } = this.masks;
    let interval = 0;
    while (interval < times.length - 2 && times[interval + 1] <= this.time) ++interval;
    const now = new Uint8Array(bytes);
    for (let i = 0; i < bytes; ++i) now[i] = bits[interval * bytes + i] | bits[(interval + 1) * bytes + i];
    return now;
  }

  // Writes the distance of each Gaussian along the axis `row` (4 numbers: direction and shift) of a camera.
  depths(row, out) {
    const [x, y, z, w] = row, { means, count } = this;
    if (this.bones) return this.depthsOnBones(row, out);
    for (let i = this.moving; i < count; ++i)
      out[i] = x * means[3 * i] + y * means[3 * i + 1] + z * means[3 * i + 2] + w;
    if (this.lines) this.addDepthsOnLines(row, out);
    if (!this.drivers) return undefined;
    const axes = axesThrough(this.drivers.values, 24, this.drivers.count, [x, y, z]);
    for (let i = 0; i < this.moving; ++i) {
      let depth = w;
      const a = means[3 * i], b = means[3 * i + 1], c = means[3 * i + 2];
      for (let k = i * this.perGaussian; k < (i + 1) * this.perGaussian; ++k) {
        const at = 4 * this.followed[k];
        depth += this.shares[k] * (a * axes[at] + b * axes[at + 1] + c * axes[at + 2] + axes[at + 3]);
      }
      out[i] = depth;
    }
    return undefined;
  }

  // Moves 4D Gaussians along their lines; those that have faded are not drawn.
  addDepthsOnLines([x, y, z], out) {
    const { moving, least, list } = this.lines, reach = Math.sqrt(-2 * Math.log(least));
    for (let i = 0; i < moving; ++i) {
      const [vx, vy, vz, mean, logStd] = list.subarray(5 * i, 5 * i + 5), elapsed = this.time - mean;
      if (Math.abs(elapsed) < reach * Math.exp(logStd)) out[i] += elapsed * (x * vx + y * vy + z * vz);
      else out[i] = -Infinity;
    }
  }

  depthsOnBones([x, y, z, w], out) {
    const { means, bones, count } = this;
    const [bx, by, bz, scale] = bones.body;
    const axes = axesThrough(bones.values, 12, bones.parents.length, [scale * x, scale * y, scale * z]);
    const shift = x * bx + y * by + z * bz + w;
    const own = this.drivers ? this.drivers.values : null;
    for (let i = 0; i < count; ++i) {
      let depth = shift, a = means[3 * i], b = means[3 * i + 1], c = means[3 * i + 2];
      if (own) { a += own[24 * i + 3]; b += own[24 * i + 7]; c += own[24 * i + 11]; }
      for (let k = 8 * i; k < 8 * i + 8; ++k) {
        const at = 4 * this.boned[k];
        depth += this.bonedShares[k] * (a * axes[at] + b * axes[at + 1] + c * axes[at + 2] + axes[at + 3]);
      }
      out[i] = depth;
    }
  }
}

// What a camera's axis is before each of `count` affine maps: direction and shift, 4 numbers each.
function axesThrough(maps, stride, count, [x, y, z]) {
  const axes = new Float32Array(4 * count);
  for (let i = 0; i < count; ++i)
    for (let k = 0; k < 4; ++k) {
      const at = stride * i + k;
      axes[4 * i + k] = x * maps[at] + y * maps[at + 4] + z * maps[at + 8];
    }
  return axes;
}
