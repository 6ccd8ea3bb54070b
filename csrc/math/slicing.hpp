// A 4D Gaussian (Yang et al. 2024) at a time t: a 3D Gaussian that moves linearly and fades in and out; and the vjp.
//
// A vector of space and time is a quaternion t + x i + y j + z k; the rotation R is v -> q_l v q_r. F = R diag(s) is a square
// root of the covariance, with spatial rows A (3x4) and the time row b (4). With P = I - b b^T / (b.b):
//   variance in time b.b,  velocity v = A b / (b.b),  covariance at a time M M^T with M = A P = A - v b^T.
//
// Differences of large numbers, which A - v b^T is of Gaussians that live long or move fast, are avoided: with the column m of
// the largest |b_m| and r_k = b_k / b_m, the columns e_k = A_k - r_k A_m (k != m) have no extent in time, and
//   M M^T = B B^T,  B = E (I - c r r^T),  c = 1 / (n (1 + n)),  n^2 = 1 + r.r.
// B keeps the lengths of the columns apart, so that Jacobi's method (math/posing.hpp) finds short axes as exactly as long ones.
//
// With B = U diag(d) V^T, W = P diag(d)^-1 A^T U has orthonormal columns, and M = U diag(d) W^T. Gradients by rotations are
// those by turns of R as a whole, gradients by log scales are sums of products of W: neither divides by a length.
#pragma once

#include "math/posing.hpp"

namespace dyngs {

// Opacity logit of a Gaussian that is not seen at a time.
inline constexpr double kFadedLogit = -1e4;
// Largest exponent of the weight in time; its square root bounds the distance in standard deviations.
inline constexpr double kLargestExponent = 80;

// exp(x), x <= 0.
template <class R>
DYNGS_HD R exp_of_negative(R x) {
  return exp2(x * real<R>(1.4426950408889634));
}

template <class R>
DYNGS_HD R exp_of_any(R x) {
  const R zero = real<R>(0), small = exp_of_negative(-abs(x));
  return select(x < zero, small, real<R>(1) / small);
}

// 1 - exp(-x), x >= 0; `decay` is exp(-x).
template <class R>
DYNGS_HD R one_minus_exp(R x, R decay) {
  constexpr int kTerms = sizeof(Scalar<R>) == 4 ? 7 : 14;
  const R one = real<R>(1);
  R sum = one;
  for (int n = kTerms; n >= 2; --n) sum = one - x * sum * real<R>(1.0 / n);
  return select(x < real<R>(0.35), x * sum, one - decay);
}

// F and what follows from its time row. Lengths are relative to the longest axis.
template <class R>
struct SpaceTime {
  Quat<R> left, right;  // unit
  R inv_left, inv_right;
  R longest;         // log of the longest axis
  Vec3<R> space[4];  // columns of A: of the axes x, y, z and t
  R time[4];         // b
  R largest;         // |b_k|
  R share[4];        // b_k / |b|
  R deviation;       // |b|
  Vec3<R> velocity;
  R nothing;  // 0, or NaN where an input is not finite
};

// `log_scales`: of the axes x, y, z and t.
template <class R>
DYNGS_HD SpaceTime<R> space_time(const Quat<R>& left, const Quat<R>& right, const R (&log_scales)[4]) {
  const R zero = real<R>(0);
  SpaceTime<R> f;
  f.left = normalize(left, f.inv_left);
  f.right = normalize(right, f.inv_right);
  f.nothing = (left.w + left.x + left.y + left.z) * zero + (right.w + right.x + right.y + right.z) * zero;
  f.longest = max(max(log_scales[0], log_scales[1]), max(log_scales[2], log_scales[3]));
  // The parts of R that mix space and time, from sums that vanish without rounding where q_r is conjugate to q_l.
  const Quat<R>&q = f.left, &r = f.right;
  const Vec3<R> vector{q.x, q.y, q.z}, sum{q.x + r.x, q.y + r.y, q.z + r.z};
  const Vec3<R> mixed = sum * q.w + vector * (r.w - q.w), turned = cross(vector, sum);
  const Vec3<R> to_time = turned - mixed, from_time = turned + mixed;
  const Quat<R> x = Quat<R>{-q.x, q.w, q.z, -q.y} * r, y = Quat<R>{-q.y, -q.z, q.w, q.x} * r;
  const Quat<R> z = Quat<R>{-q.z, q.y, -q.x, q.w} * r;
  const Vec3<R> space[4] = {{x.x, x.y, x.z}, {y.x, y.y, y.z}, {z.x, z.y, z.z}, from_time};
  const R time[4] = {to_time.x, to_time.y, to_time.z, q.w * r.w - q.x * r.x - q.y * r.y - q.z * r.z};
  f.largest = zero;
  for (int k = 0; k < 4; ++k) {
    f.nothing = f.nothing + log_scales[k] * zero;
    const R length = exp_of_negative(max(log_scales[k] - f.longest, real<R>(-kLargestExponent)));
    f.space[k] = space[k] * length;
    f.time[k] = time[k] * length;
    f.largest = max(f.largest, abs(f.time[k]));
  }
  R square = zero;
  f.velocity = {f.nothing, f.nothing, f.nothing};
  for (int k = 0; k < 4; ++k) {
    f.share[k] = f.time[k] / f.largest;
    square = square + f.share[k] * f.share[k];
  }
  const R root = sqrt(square);
  f.deviation = f.largest * root;
  for (int k = 0; k < 4; ++k) {
    f.share[k] = f.share[k] / root;
    f.velocity = f.velocity + f.space[k] * (f.share[k] / f.deviation);
  }
  return f;
}

// log |b|.
template <class R>
DYNGS_HD R log_deviation(const SpaceTime<R>& f) {
  return log(f.deviation) + (f.longest + f.nothing);
}

// The 3D Gaussian at a time, but for its mean and opacity.
template <class R>
struct SlicedShape {
  Quat<R> quat;      // U
  R log_scales[3];   // log d
  Vec3<R> basis[4];  // rows of W
};

template <class R>
DYNGS_HD SlicedShape<R> sliced_shape(const SpaceTime<R>& f) {
  const R zero = real<R>(0), one = real<R>(1);
  Vec3<R> space[4] = {f.space[0], f.space[1], f.space[2], f.space[3]};
  R time[4] = {f.time[0], f.time[1], f.time[2], f.time[3]};
  MaskOf<R> swapped[3];
  for (int k = 0; k < 3; ++k) {  // the column of the largest |b_k| becomes the last
    swapped[k] = abs(time[3]) < abs(time[k]);
    const Vec3<R> column = space[k];
    const R moment = time[k];
    space[k] = select(swapped[k], space[3], column), time[k] = select(swapped[k], time[3], moment);
    space[3] = select(swapped[k], column, space[3]), time[3] = select(swapped[k], moment, time[3]);
  }
  R ratio[3], square = zero, extent = zero;
  for (int k = 0; k < 3; ++k) {
    ratio[k] = time[k] / time[3];
    square = square + ratio[k] * ratio[k];
    space[k] = space[k] - space[3] * ratio[k];
    extent = max(extent, max(abs(space[k].x), max(abs(space[k].y), abs(space[k].z))));
  }
  const R smallest = real<R>(1e-37);
  extent = max(extent, smallest);
  const R root = sqrt(one + square), mix = one / (root * (one + root));
  Vec3<R> along{zero, zero, zero};
  for (int k = 0; k < 3; ++k) {
    space[k] = space[k] * (one / extent);
    along = along + space[k] * ratio[k];
  }
  Mat3<R> columns;
  for (int k = 0; k < 3; ++k) {
    const Vec3<R> column = space[k] - along * (mix * ratio[k]);
    for (int i = 0; i < 3; ++i) columns.m[i][k] = column[i] + f.nothing;
  }
  const Decomposition<R> d = decompose(columns);
  SlicedShape<R> out;
  out.quat = quat_of_rotation(d.axes);
  for (int k = 0; k < 3; ++k) out.log_scales[k] = log(max(d.length[k] * extent, smallest)) + (f.longest + f.nothing);
  const auto& v = d.turned.m;
  Vec3<R> across{zero, zero, zero};
  for (int k = 0; k < 3; ++k) {
    out.basis[k] = {v[k][0], v[k][1], v[k][2]};
    across = across + out.basis[k] * ratio[k];
  }
  for (int k = 0; k < 3; ++k) out.basis[k] = out.basis[k] - across * (mix * ratio[k]);
  out.basis[3] = across * (-one / root);
  for (int k = 2; k >= 0; --k) {
    const Vec3<R> row = out.basis[k];
    out.basis[k] = select(swapped[k], out.basis[3], row);
    out.basis[3] = select(swapped[k], row, out.basis[3]);
  }
  return out;
}

// Where a Gaussian is `delay` after its own time, and how visible: p = exp(-exponent), opacity sigmoid(logit) p.
template <class R>
struct Visibility {
  R exponent;   // delay^2 / (2 b.b)
  R distance;   // delay / |b|
  R deviation;  // |b|, in units of time
  R logit;
  R by_exponent, by_logit;  // derivatives of the logit
  MaskOf<R> faded;          // p is too small, which has no gradient
};

// `limit`: exponent from which p is too small.
template <class R>
DYNGS_HD Visibility<R> visibility(const SpaceTime<R>& f, R delay, R logit, Scalar<R> limit) {
  const R zero = real<R>(0), one = real<R>(1);
  Visibility<R> v;
  v.deviation = max(f.deviation * exp_of_any(f.longest), real<R>(1e-37));
  v.distance = delay / v.deviation + f.nothing;
  v.exponent = real<R>(0.5) * v.distance * v.distance;
  v.faded = R(limit) <= v.exponent;
  const R p = exp_of_negative(-v.exponent), rest = one_minus_exp(v.exponent, p);
  // The odds e^logit p / (1 + e^logit (1 - p)), without overflow for either sign of the logit.
  const R negative = min(logit, zero), odds = exp_of_negative(negative), inverse = exp_of_negative(-max(logit, zero));
  const R sum = odds * rest + inverse;
  v.logit = select(v.faded, real<R>(kFadedLogit), negative - v.exponent - log(sum) + logit * zero);
  v.by_exponent = -one - odds * p / sum;
  v.by_logit = inverse / sum;
  return v;
}

// mean + velocity * delay; far outside of a Gaussian's life at most 1e18 away.
template <class R>
DYNGS_HD Vec3<R> sliced_mean(const Vec3<R>& mean, const Vec3<R>& velocity, R delay) {
  const R most = real<R>(1e18);
  const auto within = [&](R x) { return select(most < x, most, select(x < -most, -most, x)); };
  return mean + Vec3<R>{within(velocity.x * delay), within(velocity.y * delay), within(velocity.z * delay)};
}

// Gradients by the sliced Gaussian.
template <class R>
struct SliceGrad {
  Vec3<R> mean;
  Quat<R> quat;
  R log_scales[3];
  R logit;
};

// Gradients by the 4D Gaussian.
template <class R>
struct SpaceTimeGrad {
  Vec3<R> mean;
  R time;
  Quat<R> left, right;
  R log_scales[4];
  R logit;
};

// With N = G_M M^T for the gradient G_M by M: in the frame of U, N_ii is the gradient by log d_i, and N_ij - N_ji that by turns
// of U. N_ij + N_ji = (N_ij - N_ji) (d_j^2 + d_i^2) / (d_j^2 - d_i^2), whose last factor is bounded where axes are equal.
template <class R>
DYNGS_HD SpaceTimeGrad<R> slice_vjp(const SpaceTime<R>& f, const SlicedShape<R>& shape, R delay, R logit,
                                    Scalar<R> limit, const SliceGrad<R>& g) {
  const R zero = real<R>(0), half = real<R>(0.5), one = real<R>(1), two = real<R>(2);
  const R bound = real<R>(kEpsilon<Scalar<R>>);  // relative, of squared gaps
  const Visibility<R> v = visibility(f, delay, logit, limit);
  const R by_exponent = g.logit * v.by_exponent, spread = two * by_exponent * v.exponent;
  const Mat3<R> axes = rotation_matrix(shape.quat);
  const Vec3<R> turn = turn_about_axes_vjp(shape.quat, g.quat);
  const Vec3<R> by_velocity = transposed_times(axes, g.mean * delay), velocity = transposed_times(axes, f.velocity);
  R rate[3];  // d / |b|
  for (int i = 0; i < 3; ++i) {
    const R length = exp_of_negative(shape.log_scales[i] - f.longest);
    rate[i] = min(length / f.deviation, real<R>(1e15));
  }
  const R twist[3] = {-turn.z, turn.y, -turn.x};  // N_ij - N_ji of the pairs below
  R shear[3];                                     // twist d_i d_j / (d_j^2 - d_i^2)
  R by_slope[3] = {velocity.x * g.log_scales[0], velocity.y * g.log_scales[1], velocity.z * g.log_scales[2]};  // N^T v
  for (int pair = 0; pair < 3; ++pair) {
    const int i = pair == 2 ? 1 : 0, j = pair == 0 ? 1 : 2;
    const R difference = shape.log_scales[j] - shape.log_scales[i];
    const R ratio = exp_of_negative(-abs(difference)), square = ratio * ratio;
    const R sum = one + square, gap = select(difference < zero, square - one, one - square);
    const R gap2 = gap * gap, bound2 = bound * sum * sum;
    const R inverse = gap * gap2 / (gap2 * gap2 + bound2 * bound2);  // 1 / gap, if that is not too small
    shear[pair] = twist[pair] * ratio * inverse;
    const R mean = half * twist[pair] * sum * inverse;
    by_slope[j] = by_slope[j] + velocity[i] * (mean + half * twist[pair]);
    by_slope[i] = by_slope[i] + velocity[j] * (mean - half * twist[pair]);
  }
  const R along = dot(velocity, by_velocity) + spread;
  R tilt[3];
  for (int i = 0; i < 3; ++i)
    tilt[i] = by_velocity[i] + along * velocity[i] + by_slope[i] - rate[i] * rate[i] * by_velocity[i];
  const Vec3<R> by_tilt = axes * Vec3<R>{tilt[0], tilt[1], tilt[2]};
  const Vec3<R> by_turn = axes * (turn + cross(velocity, by_velocity));
  const auto visible = [&](R x) { return select(v.faded, zero, x); };
  const auto scaled = [&](const Quat<R>& q, R by) {
    return Quat<R>{visible(q.w * by), visible(q.x * by), visible(q.y * by), visible(q.z * by)};
  };
  const Vec3<R> left = by_tilt + by_turn, right = by_tilt - by_turn;
  SpaceTimeGrad<R> out;
  out.left = scaled(Quat<R>{zero, left.x, left.y, left.z} * f.left, f.inv_left);
  out.right = scaled(f.right * Quat<R>{zero, right.x, right.y, right.z}, f.inv_right);
  for (int k = 0; k < 4; ++k) {
    const Vec3<R>& w = shape.basis[k];
    R sum = -spread * f.share[k] * f.share[k];
    for (int i = 0; i < 3; ++i)
      sum = sum + w[i] * (g.log_scales[i] * w[i] + two * f.share[k] * rate[i] * by_velocity[i]);
    sum = sum + two * (shear[0] * w.x * w.y + shear[1] * w.x * w.z + shear[2] * w.y * w.z);
    out.log_scales[k] = visible(sum);
  }
  const R by_delay = dot(f.velocity, g.mean) + by_exponent * v.distance / v.deviation;
  out.mean = {visible(g.mean.x), visible(g.mean.y), visible(g.mean.z)};
  out.time = visible(-by_delay);
  out.logit = visible(g.logit * v.by_logit);
  return out;
}

// cos(2 pi n x) and sin(2 pi n x).
template <class R>
struct Wave {
  R cosine, sine;
};

// n = 1, of a number: whole periods are left out exactly.
template <class S>
DYNGS_HD Wave<S> first_wave(S x) {
  const S phase = S(6.283185307179586) * (x - trunc(x));
  return {cos(phase), sin(phase)};
}

template <class R>
DYNGS_HD Wave<R> next_wave(const Wave<R>& wave, const Wave<R>& first) {
  return {wave.cosine * first.cosine - wave.sine * first.sine, wave.sine * first.cosine + wave.cosine * first.sine};
}

}  // namespace dyngs
