// Inputs of the network of compact colour, row by row (math/shading.hpp).
#include "core/api.hpp"

#include <algorithm>
#include <cmath>

#include "cpu/parallel.hpp"
#include "math/shading.hpp"

namespace dyngs {
namespace {

constexpr int64_t kGrain = 1024;

template <class S>
S* put(S* out, const Vec3<S>& v) {
  out[0] = v.x, out[1] = v.y, out[2] = v.z;
  return out + 3;
}

template <class S>
void write_row(const Shading<S>& in, const Mat3<S>& turn, int64_t row, S* out) {
  const int64_t i = in.picked[row];
  const Vec3<S> mean = load_vec3(in.means + 3 * i), place = in.places ? load_vec3(in.places + 3 * i) : mean;
  const S* box = in.box;
  out =
      put(out, contracted<S>({(place.x - box[0]) / box[3], (place.y - box[1]) / box[4], (place.z - box[2]) / box[5]}));
  S inv_norm;  // for a gradient, which is not needed
  Vec3<S> direction = normalize(mean - load_vec3(in.eye), inv_norm);
  if (in.turn) direction = transposed_times(turn, direction);
  out = put(out, direction);
  if (in.normals) {
    Vec3<S> normal = shortest_axis(load_quat(in.quats + 4 * i), in.log_scales + 3 * i);
    if (in.turn) normal = transposed_times(turn, normal);
    const S cosine = dot(normal, direction);
    *out++ = std::abs(cosine);
    out = put(out, reflected(direction, normal, cosine));
  }
  const S* base = in.base + 3 * row;
  out = put<S>(out, {base[0] - S(0.5), base[1] - S(0.5), base[2] - S(0.5)});
  if (in.timed) *out = in.time;
}

}  // namespace

template <class S>
void shading_inputs(const Shading<S>& in, S* out) {
  Mat3<S> turn;  // from rest to the world
  if (in.turn) std::copy(in.turn, in.turn + 9, turn.m[0]);
  parallel_for(in.rows, kGrain, in.threads, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) write_row(in, turn, row, out + row * in.width());
  });
}

template void shading_inputs<float>(const Shading<float>&, float*);
template void shading_inputs<double>(const Shading<double>&, double*);

}  // namespace dyngs
