// Slicing of 4D Gaussians, as many at a time as a register holds.
#include "math/slicing.hpp"
#include "core/api.hpp"

#include <algorithm>

#include "cpu/lanes.hpp"
#include "cpu/parallel.hpp"
#include "cpu/simd.hpp"

namespace dyngs {
namespace {

constexpr int64_t kBlock = 512;

template <class S>
Vec3<Native<S>> load3(const S* rows, int64_t first, int count) {
  Native<S> x[3];
  load_lanes(rows, first, count, x);
  return {x[0], x[1], x[2]};
}
template <class S>
Quat<Native<S>> load4(const S* rows, int64_t first, int count) {
  Native<S> x[4];
  load_lanes(rows, first, count, x);
  return {x[0], x[1], x[2], x[3]};
}
template <class S>
Native<S> load1(const S* rows, int64_t first, int count) {
  Native<S> x[1];
  load_lanes(rows, first, count, x);
  return x[0];
}

template <class S>
void store3(S* rows, int64_t first, int count, const Vec3<Native<S>>& v) {
  const Native<S> x[3] = {v.x, v.y, v.z};
  store_lanes(rows, first, count, x);
}
template <class S>
void store4(S* rows, int64_t first, int count, const Quat<Native<S>>& q) {
  const Native<S> x[4] = {q.w, q.x, q.y, q.z};
  store_lanes(rows, first, count, x);
}
template <class S>
void store1(S* rows, int64_t first, int count, const Native<S>& v) {
  const Native<S> x[1] = {v};
  store_lanes(rows, first, count, x);
}

template <class S>
SpaceTime<Native<S>> load_space_time(const SpaceTimeGaussians<S>& in, int64_t first, int count) {
  const Vec3<Native<S>> logs = load3(in.log_scales, first, count);
  const Native<S> log_scales[4] = {logs.x, logs.y, logs.z, load1(in.log_spans, first, count)};
  return space_time(load4(in.quats, first, count), load4(in.right_quats, first, count), log_scales);
}

// sum_j a_j b_j.
template <class S>
S product_sum(const S* a, const S* b, int64_t count) {
  constexpr int kSize = Native<S>::kSize;
  Native<S> sums(S(0));
  int64_t j = 0;
  for (; j + kSize <= count; j += kSize) sums += Native<S>::load(a + j) * Native<S>::load(b + j);
  S sum = horizontal_sum(sums);
  for (; j < count; ++j) sum += a[j] * b[j];
  return sum;
}

// f(first, count) for every group of lanes.
template <class S, class F>
void for_each_group(int64_t count, int threads, F&& f) {
  constexpr int kSize = Native<S>::kSize;
  parallel_for(count, kBlock, threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += kSize) f(i, static_cast<int>(std::min<int64_t>(kSize, end - i)));
  });
}

}  // namespace

template <class S>
void slice_forward(const SpaceTimeGaussians<S>& in, const SliceTime<S>& at, const Slice<S>& out, int threads) {
  using R = Native<S>;
  for_each_group<S>(in.count, threads, [&](int64_t i, int n) {
    const SpaceTime<R> f = load_space_time(in, i, n);
    const SlicedShape<R> shape = sliced_shape(f);
    const R delay = R(at.time) - load1(in.times, i, n);
    store3(out.means, i, n, sliced_mean(load3(in.means, i, n), f.velocity, delay));
    store1(out.logit_opacities, i, n, visibility(f, delay, load1(in.logit_opacities, i, n), at.most_faded).logit);
    store4(out.quats, i, n, shape.quat);
    store_lanes(out.log_scales, i, n, shape.log_scales);
    R basis[12];
    for (int k = 0; k < 12; ++k) basis[k] = shape.basis[k / 3][k % 3];
    store_lanes(out.basis, i, n, basis);
  });
}

template <class S>
void slice_backward(const SpaceTimeGaussians<S>& in, const SliceTime<S>& at, const Slice<const S>& slice,
                    const SliceGrads<S>& g, const SpaceTimeGrads<S>& out, int threads) {
  using R = Native<S>;
  for_each_group<S>(in.count, threads, [&](int64_t i, int n) {
    const SpaceTime<R> f = load_space_time(in, i, n);
    SlicedShape<R> shape;
    shape.quat = load4(slice.quats, i, n);
    load_lanes(slice.log_scales, i, n, shape.log_scales);
    R basis[12];
    load_lanes(slice.basis, i, n, basis);
    for (int k = 0; k < 4; ++k) shape.basis[k] = load_vec3(basis + 3 * k);
    SliceGrad<R> by;
    by.mean = load3(g.means, i, n), by.quat = load4(g.quats, i, n);
    load_lanes(g.log_scales, i, n, by.log_scales);
    by.logit = load1(g.logit_opacities, i, n);
    const R delay = R(at.time) - load1(in.times, i, n);
    const SpaceTimeGrad<R> found = slice_vjp(f, shape, delay, load1(in.logit_opacities, i, n), at.most_faded, by);
    store3(out.means, i, n, found.mean), store1(out.times, i, n, found.time);
    store4(out.quats, i, n, found.left), store4(out.right_quats, i, n, found.right);
    store3(out.log_scales, i, n, load_vec3(found.log_scales)), store1(out.log_spans, i, n, found.log_scales[3]);
    store1(out.logit_opacities, i, n, found.logit);
  });
}

template <class S>
void condition(const SpaceTimeGaussians<S>& in, const Conditional<S>& out, int threads) {
  using R = Native<S>;
  for_each_group<S>(in.count, threads, [&](int64_t i, int n) {
    const SpaceTime<R> f = load_space_time(in, i, n);
    const SlicedShape<R> shape = sliced_shape(f);
    store4(out.quats, i, n, shape.quat);
    store_lanes(out.log_scales, i, n, shape.log_scales);
    store3(out.velocities, i, n, f.velocity);
    store1(out.log_deviations, i, n, log_deviation(f));
  });
}

template <class S>
void time_harmonics(const TimeHarmonics<S>& in, S* out, int threads) {
  parallel_for(in.count, kBlock, threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      S* to = out + i * in.width;
      std::copy_n(in.sh + i * in.width, in.width, to);
      if (!in.seen[i]) continue;
      const S* amplitude = in.sh_time + (in.rows ? in.rows[i] : i) * in.waves * in.width;
      const Wave<S> first = first_wave(in.elapsed[i]);
      Wave<S> wave = first;
      for (int64_t n = 0; n < in.waves; ++n, amplitude += in.width, wave = next_wave(wave, first))
        for (int64_t j = 0; j < in.width; ++j) to[j] += wave.cosine * amplitude[j];
    }
  });
}

template <class S>
void time_harmonics_backward(const TimeHarmonics<S>& in, const S* g, S* by_sh_time, S* by_elapsed, int threads) {
  parallel_for(in.count, kBlock, threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const int64_t row = (in.rows ? in.rows[i] : i) * in.waves * in.width;
      const S *by = g + i * in.width, *amplitude = in.sh_time + row;
      S* to = by_sh_time + row;
      by_elapsed[i] = 0;
      if (!in.seen[i]) {
        std::fill_n(to, in.waves * in.width, S(0));
        continue;
      }
      const Wave<S> first = first_wave(in.elapsed[i]);
      Wave<S> wave = first;
      for (int64_t n = 1; n <= in.waves; ++n, amplitude += in.width, to += in.width, wave = next_wave(wave, first)) {
        by_elapsed[i] -= S(6.283185307179586) * S(n) * wave.sine * product_sum(by, amplitude, in.width);
        for (int64_t j = 0; j < in.width; ++j) to[j] = wave.cosine * by[j];
      }
    }
  });
}

#define DYNGS_INSTANTIATE(S)                                                                                \
  template void slice_forward<S>(const SpaceTimeGaussians<S>&, const SliceTime<S>&, const Slice<S>&, int);  \
  template void slice_backward<S>(const SpaceTimeGaussians<S>&, const SliceTime<S>&, const Slice<const S>&, \
                                  const SliceGrads<S>&, const SpaceTimeGrads<S>&, int);                     \
  template void condition<S>(const SpaceTimeGaussians<S>&, const Conditional<S>&, int);                     \
  template void time_harmonics<S>(const TimeHarmonics<S>&, S*, int);                                        \
  template void time_harmonics_backward<S>(const TimeHarmonics<S>&, const S*, S*, S*, int);
DYNGS_INSTANTIATE(float)
DYNGS_INSTANTIATE(double)
#undef DYNGS_INSTANTIATE

}  // namespace dyngs
