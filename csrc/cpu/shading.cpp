#include "cpu/shading.hpp"

#include <algorithm>
#include <cmath>

#include "cpu/parallel.hpp"
#include "math/projection.hpp"

namespace dyngs {
namespace {

constexpr int64_t kGrain = 1024;

template <class S>
struct Vec {
  S x, y, z;
};

template <class S>
S dot(Vec<S> a, Vec<S> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class S>
Vec<S> scaled(Vec<S> a, S s) { return {a.x * s, a.y * s, a.z * s}; }
template <class S>
Vec<S> vec(const S* p) { return {p[0], p[1], p[2]}; }
template <class S>
S* put(S* out, Vec<S> v) {
  out[0] = v.x, out[1] = v.y, out[2] = v.z;
  return out + 3;
}

// The row vector v times the matrix m (3, 3).
template <class S>
Vec<S> times(Vec<S> v, const S* m) {
  return {v.x * m[0] + v.y * m[3] + v.z * m[6], v.x * m[1] + v.y * m[4] + v.z * m[7],
          v.x * m[2] + v.y * m[5] + v.z * m[8]};
}

// The column of the rotation `q` that belongs to the smallest of the scales, of equal ones the first.
template <class S>
Vec<S> shortest_axis(const S* q, const S* log_scales) {
  S inv_norm;  // for a gradient, which is not needed
  const auto [w, x, y, z] = normalize(Quat<S>{q[0], q[1], q[2], q[3]}, inv_norm);
  switch (std::min_element(log_scales, log_scales + 3) - log_scales) {
    case 0: return {1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)};
    case 1: return {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)};
    default: return {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)};
  }
}

// x within the unit ball, what lies outside drawn into one of radius 2 (Barron et al. 2022).
template <class S>
Vec<S> contracted(Vec<S> x) {
  const S length = std::max(std::sqrt(dot(x, x)), S(1));
  return scaled(x, (2 - 1 / length) / length);
}

template <class S>
void write_row(const Shading<S>& in, int64_t row, S* out) {
  const int64_t i = in.picked[row];
  const Vec<S> mean = vec(in.means + 3 * i), place = in.places ? vec(in.places + 3 * i) : mean;
  const S* box = in.box;
  out = put(out, contracted<S>({(place.x - box[0]) / box[3], (place.y - box[1]) / box[4], (place.z - box[2]) / box[5]}));
  const Vec<S> ray{mean.x - in.eye[0], mean.y - in.eye[1], mean.z - in.eye[2]};
  Vec<S> direction = scaled(ray, 1 / std::max(std::sqrt(dot(ray, ray)), S(1e-12)));
  if (in.turn) direction = times(direction, in.turn);
  out = put(out, direction);
  if (in.normals) {
    Vec<S> normal = shortest_axis(in.quats + 4 * i, in.log_scales + 3 * i);
    if (in.turn) normal = times(normal, in.turn);
    const S cosine = dot(normal, direction), twice = 2 * cosine;
    *out++ = std::abs(cosine);
    out = put<S>(out, {direction.x - twice * normal.x, direction.y - twice * normal.y, direction.z - twice * normal.z});
  }
  const S* base = in.base + 3 * row;
  out = put<S>(out, {base[0] - S(0.5), base[1] - S(0.5), base[2] - S(0.5)});
  if (in.timed) *out = in.time;
}

}  // namespace

template <class S>
void shading_inputs(const Shading<S>& in, S* out) {
  parallel_for(in.rows, kGrain, in.threads, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) write_row(in, row, out + row * in.width());
  });
}

template void shading_inputs<float>(const Shading<float>&, float*);
template void shading_inputs<double>(const Shading<double>&, double*);

}  // namespace dyngs
