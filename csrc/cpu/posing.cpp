// Sixteen Gaussians at a time. Blending works on rows of one Gaussian or joint, padded to sixteen numbers, the covariances on
// one number of many Gaussians; a transpose lies between. The gradients by the transforms are summed per block of Gaussians,
// and the blocks in order.
#include "core/api.hpp"

#include <algorithm>
#include <vector>

#include "cpu/lanes.hpp"
#include "cpu/parallel.hpp"
#include "cpu/simd.hpp"
#include "cpu/transpose.hpp"
#include "math/posing.hpp"

namespace dyngs {
namespace {

constexpr int64_t kBlock = 32 * kLanes;
constexpr int kAffine = 12;  // numbers of a transform, and of what is kept for the backward pass

// The first `count` of at most sixteen numbers, then zeros.
template <class S>
Packet<S> load_some(const S* from, int64_t count) {
  if (count >= kLanes) return Packet<S>::load(from);
  Packet<S> r(S(0));
  for (int i = 0; i < count; ++i) r[i] = from[i];
  return r;
}
template <class S>
void store_some(S* to, const Packet<S>& x, int64_t count) {
  for (int i = 0; i < count; ++i) to[i] = x[i];
}

// Rows of twelve numbers of `count`, through a transpose; zeros for missing rows.
template <class S>
void load_twelve(const S* from, int64_t first, int count, Packet<S> (&to)[kLanes]) {
  from += kAffine * first;
  for (int i = 0; i < kLanes; ++i) {
    if (i + 2 < count)
      to[i] = Packet<S>::load(from + kAffine * i);  // with the beginning of the next row, which nobody reads
    else
      to[i] = i < count ? load_some(from + kAffine * i, kAffine) : Packet<S>(S(0));
  }
  transpose16(to);  // the last four are of no meaning
}
// Takes the rows themselves.
template <class S>
void store_twelve(S* to, int64_t first, int count, const Packet<S> (&rows)[kLanes]) {
  to += kAffine * first;
  for (int i = 0; i < count; ++i) {
    if (i + 2 < count)
      rows[i].store(to + kAffine * i);  // with four more, which the next row overwrites
    else
      store_some(to + kAffine * i, rows[i], kAffine);
  }
}

// The transforms, a row of kLanes numbers each.
template <class S>
std::vector<S> joint_rows(const Posing<S>& in) {
  std::vector<S> rows(in.joints * kLanes);
  for (int64_t j = 0; j < in.joints; ++j) std::copy_n(in.transforms + kAffine * j, kAffine, rows.data() + kLanes * j);
  return rows;
}

// The lanes of a packet that fill one register, because a covariance needs dozens of registers.
template <class S>
Native<S> part(const Packet<S>& x, int lane) {
  return Native<S>::load(reinterpret_cast<const S*>(&x) + lane);
}
template <class S>
void put(Packet<S>& to, int lane, const Native<S>& x) {
  x.store(&to[lane]);
}

// Registers that hold the numbers of a transform.
template <class S>
constexpr int kRegisters = (kAffine + Native<S>::kSize - 1) / Native<S>::kSize;

// sum_j w_j A_j of one Gaussian.
template <class S>
Packet<S> blend(const S* weights, const S* joints, int64_t num_joints) {
  using N = Native<S>;
  N sum[kRegisters<S>];
  for (N& x : sum) x = N(S(0));
  for (int64_t j = 0; j < num_joints; ++j) {
    const N weight(weights[j]);
    for (int r = 0; r < kRegisters<S>; ++r) sum[r] += weight * N::load(joints + kLanes * j + N::kSize * r);
  }
  Packet<S> t(S(0));
  for (int r = 0; r < kRegisters<S>; ++r) put(t, N::kSize * r, sum[r]);
  return t;
}

// Of sixteen Gaussians, means, quaternions and log scales or the gradients by them.
template <class S>
struct Lanes {
  Packet<S> mean[3], quat[4], log_scales[3];

  Vec3<Native<S>> mean_at(int lane) const { return {part(mean[0], lane), part(mean[1], lane), part(mean[2], lane)}; }
  Quat<Native<S>> quat_at(int lane) const {
    return {part(quat[0], lane), part(quat[1], lane), part(quat[2], lane), part(quat[3], lane)};
  }
  void put_at(int lane, const Vec3<Native<S>>& x, const Quat<Native<S>>& q, const Native<S> (&logs)[3]) {
    put(mean[0], lane, x.x), put(mean[1], lane, x.y), put(mean[2], lane, x.z);
    put(quat[0], lane, q.w), put(quat[1], lane, q.x), put(quat[2], lane, q.y), put(quat[3], lane, q.z);
    for (int k = 0; k < 3; ++k) put(log_scales[k], lane, logs[k]);
  }
};

template <class S>
Lanes<S> load_gaussians(const S* means, const S* quats, const S* log_scales, int64_t first, int count) {
  Lanes<S> g;
  load_lanes(means, first, count, g.mean), load_lanes(quats, first, count, g.quat);
  load_lanes(log_scales, first, count, g.log_scales);
  return g;
}
template <class S>
void store_gaussians(const Lanes<S>& g, int64_t first, int count, S* means, S* quats, S* log_scales) {
  store_lanes(means, first, count, g.mean), store_lanes(quats, first, count, g.quat);
  store_lanes(log_scales, first, count, g.log_scales);
}

template <class S>
Mat3<Native<S>> linear_part(const Packet<S> (&t)[kLanes], int lane) {
  Mat3<Native<S>> linear;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) linear.m[i][j] = part(t[4 * i + j], lane);
  return linear;
}

template <class S>
RestShape<Native<S>> shape_at(const Lanes<S>& rest, int lane) {
  const Native<S> logs[3] = {part(rest.log_scales[0], lane), part(rest.log_scales[1], lane),
                             part(rest.log_scales[2], lane)};
  return rest_shape(rest.quat_at(lane), logs);
}

template <class S>
void forward_lanes(const Posing<S>& in, const S* joints, int64_t first, int count, const Posed<S>& out) {
  using N = Native<S>;
  Packet<S> t[kLanes], kept[kLanes] = {};
  for (int i = 0; i < kLanes; ++i)
    t[i] = blend(in.weights + (first + std::min(i, count - 1)) * in.joints, joints, in.joints);
  store_twelve(out.blended, first, count, t);
  transpose16(t);
  const Lanes<S> rest = load_gaussians(in.means, in.quats, in.log_scales, first, count);
  Lanes<S> to;
  for (int lane = 0; lane < kLanes; lane += N::kSize) {
    const Mat3<N> linear = linear_part(t, lane);
    const MovedShape<N> moved = move_shape(linear, shape_at(rest, lane));
    const Vec3<N> shift{part(t[3], lane), part(t[7], lane), part(t[11], lane)};
    to.put_at(lane, moved_point(linear, shift, rest.mean_at(lane)), moved.quat, moved.log_scales);
    for (int k = 0; k < 9; ++k) put(kept[k], lane, moved.turned.m[k / 3][k % 3]);
    for (int k = 0; k < 3; ++k) put(kept[9 + k], lane, moved.length[k]);
  }
  store_gaussians(to, first, count, out.means, out.quats, out.log_scales);
  transpose16(kept);
  store_twelve(out.kept, first, count, kept);
}

template <class S>
MovedShape<Native<S>> moved_at(const Packet<S> (&quats)[4], const Packet<S> (&kept)[kLanes], int lane) {
  MovedShape<Native<S>> moved;
  moved.quat = {part(quats[0], lane), part(quats[1], lane), part(quats[2], lane), part(quats[3], lane)};
  for (int k = 0; k < 9; ++k) moved.turned.m[k / 3][k % 3] = part(kept[k], lane);
  for (int k = 0; k < 3; ++k) moved.length[k] = part(kept[9 + k], lane);
  return moved;
}

// The gradients by sixteen Gaussians at rest; returns that by T in the order of `blended`, then four numbers of no meaning.
template <class S>
void shape_lanes(const Posing<S>& in, const Posed<const S>& posed, const PosedGrads<S>& g, int64_t first, int count,
                 const PosingGrads<S>& out, Packet<S> (&by_blended)[kLanes]) {
  using N = Native<S>;
  Packet<S> t[kLanes], kept[kLanes], quats[4];
  load_twelve(posed.blended, first, count, t), load_twelve(posed.kept, first, count, kept);
  load_lanes(posed.quats, first, count, quats);
  const Lanes<S> rest = load_gaussians(in.means, in.quats, in.log_scales, first, count);
  const Lanes<S> by = load_gaussians(g.means, g.quats, g.log_scales, first, count);
  std::fill(by_blended, by_blended + kLanes, Packet<S>(S(0)));
  if (g.blended != nullptr) load_twelve(g.blended, first, count, by_blended);
  Lanes<S> to;
  for (int lane = 0; lane < kLanes; lane += N::kSize) {
    const Mat3<N> linear = linear_part(t, lane);
    const N by_logs[3] = {part(by.log_scales[0], lane), part(by.log_scales[1], lane), part(by.log_scales[2], lane)};
    MovedShapeGrad<N> grad =
        move_shape_vjp(linear, shape_at(rest, lane), moved_at(quats, kept, lane), by.quat_at(lane), by_logs);
    const Vec3<N> by_mean = by.mean_at(lane);
    to.put_at(lane, moved_point_vjp(linear, rest.mean_at(lane), by_mean, grad.linear), grad.quat, grad.log_scales);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 4; ++j) {
        Packet<S>& sum = by_blended[4 * i + j];
        put(sum, lane, part(sum, lane) + (j < 3 ? grad.linear.m[i][j] : by_mean[i]));
      }
  }
  store_gaussians(to, first, count, out.means, out.quats, out.log_scales);
}

// The gradients by the weights, sixteen joints at a time.
template <class S>
void weight_lanes(const S* joints, int64_t num_joints, int64_t first, int count, const Packet<S> (&by_blended)[kLanes],
                  S* out) {
  using N = Native<S>;
  for (int64_t begin = 0; begin < num_joints; begin += kLanes) {
    const int64_t some = std::min<int64_t>(kLanes, num_joints - begin);
    Packet<S> by[kLanes] = {};
    for (int lane = 0; lane < kLanes; lane += N::kSize) {
      N by_number[kAffine];
      for (int k = 0; k < kAffine; ++k) by_number[k] = part(by_blended[k], lane);
      for (int64_t j = 0; j < some; ++j) {
        N sum(S(0));
        for (int k = 0; k < kAffine; ++k) sum += by_number[k] * N(joints[kLanes * (begin + j) + k]);
        put(by[j], lane, sum);
      }
    }
    transpose16(by);
    for (int i = 0; i < count; ++i) {
      S* row = out + (first + i) * num_joints + begin;
      some == kLanes ? by[i].store(row) : store_some(row, by[i], some);
    }
  }
}

// Adds weights (count, J) times rows of gradients to `sums`, a row of kLanes numbers per joint.
template <class S>
void add_transforms(const S* weights, int64_t num_joints, int count, const Packet<S> (&rows)[kLanes], S* sums) {
  using N = Native<S>;
  for (int64_t j = 0; j < num_joints; ++j) {
    N sum[kRegisters<S>];
    for (int r = 0; r < kRegisters<S>; ++r) sum[r] = N::load(sums + kLanes * j + N::kSize * r);
    for (int i = 0; i < count; ++i) {
      const N weight(weights[i * num_joints + j]);
      for (int r = 0; r < kRegisters<S>; ++r) sum[r] += weight * part(rows[i], N::kSize * r);
    }
    for (int r = 0; r < kRegisters<S>; ++r) sum[r].store(sums + kLanes * j + N::kSize * r);
  }
}

template <class S>
void backward_lanes(const Posing<S>& in, const S* joints, const Posed<const S>& posed, const PosedGrads<S>& g,
                    int64_t first, int count, const PosingGrads<S>& out, S* sums) {
  Packet<S> by_blended[kLanes];
  shape_lanes(in, posed, g, first, count, out, by_blended);
  if (out.weights != nullptr) weight_lanes(joints, in.joints, first, count, by_blended, out.weights);
  transpose16(by_blended);
  add_transforms(in.weights + first * in.joints, in.joints, count, by_blended, sums);
}

}  // namespace

template <class S>
void pose_forward(const Posing<S>& in, const Posed<S>& out, int threads) {
  const auto joints = joint_rows(in);
  parallel_for(in.count, kBlock, threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += kLanes)
      forward_lanes(in, joints.data(), i, static_cast<int>(std::min<int64_t>(kLanes, end - i)), out);
  });
}

template <class S>
void pose_backward(const Posing<S>& in, const Posed<const S>& posed, const PosedGrads<S>& g, const PosingGrads<S>& out,
                   int threads) {
  const auto joints = joint_rows(in);
  const int64_t blocks = (in.count + kBlock - 1) / kBlock;
  std::vector<S> sums(blocks * in.joints * kLanes);
  parallel_for(in.count, kBlock, threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += kLanes)
      backward_lanes(in, joints.data(), posed, g, i, static_cast<int>(std::min<int64_t>(kLanes, end - i)), out,
                     sums.data() + begin / kBlock * in.joints * kLanes);
  });
  for (int64_t j = 0; j < in.joints; ++j)
    for (int k = 0; k < kAffine; ++k) {
      double total = 0;
      for (int64_t b = 0; b < blocks; ++b) total += sums[(b * in.joints + j) * kLanes + k];
      out.transforms[kAffine * j + k] = static_cast<S>(total);
    }
}

#define DYNGS_INSTANTIATE(S)                                                                                           \
  template void pose_forward<S>(const Posing<S>&, const Posed<S>&, int);                                               \
  template void pose_backward<S>(const Posing<S>&, const Posed<const S>&, const PosedGrads<S>&, const PosingGrads<S>&, \
                                 int);
DYNGS_INSTANTIATE(float)
DYNGS_INSTANTIATE(double)
#undef DYNGS_INSTANTIATE

}  // namespace dyngs
