// Compiles every formula of csrc/math for the device, in float and in double. It is compiled only, never run: a formula
// that includes, calls or allocates what a GPU does not have fails here (`.ci/run` has the command).
#include "math/adam.hpp"
#include "math/blend.hpp"
#include "math/covariance.hpp"
#include "math/ellipse.hpp"
#include "math/harmonics.hpp"
#include "math/hash_grid.hpp"
#include "math/planes.hpp"
#include "math/posing.hpp"
#include "math/projection.hpp"
#include "math/quaternion.hpp"
#include "math/scalar.hpp"
#include "math/shading.hpp"
#include "math/skinning.hpp"
#include "math/slicing.hpp"
#include "math/ssim.hpp"
#include "math/vec.hpp"
#include "math/volume.hpp"

namespace dyngs {

// Numbers in, one number out, so that nothing is optimised away.
template <class S>
struct Numbers {
  const S* in;
  S* out;

  __device__ S next() { return *in++; }
  __device__ Vec3<S> vec() { return {next(), next(), next()}; }
  __device__ Quat<S> quat() { return {next(), next(), next(), next()}; }
  __device__ void put(S x) { *out += x; }
  __device__ void put(const Vec3<S>& v) { put(v.x + v.y + v.z); }
  __device__ void put(const Quat<S>& q) { put(q.w + q.x + q.y + q.z); }
};

template <class S>
__global__ void rotations(Numbers<S> n) {
  S inv_norm;
  const Quat<S> q = normalize(n.quat(), inv_norm);
  const Mat3<S> r = rotation_matrix(q * n.quat());
  n.put(normalize_vjp(q, inv_norm, rotation_matrix_vjp(q, rotation_minus_identity(q))));
  const Vec3<S> v = n.vec(), unit = normalize(v, inv_norm);
  n.put(normalize_vjp(unit, inv_norm, v + unit) + r * v + transposed_times(r, v - unit));
  n.put(clamp(n.next(), n.next(), n.next()) + abs(n.next()) + ceil(n.next()) + dot3(v.x, v.y, v.z, v.x, v.y, v.z));
}

template <class S>
__global__ void projection(Numbers<S> n) {
  const Pinhole<S> camera{
      rotation_matrix(n.quat()), n.vec(), n.next(), n.next(), n.next(), n.next(), n.next(), n.next()};
  const Quat<S> unit = n.quat();
  const Vec3<S> scale = n.vec();
  const S eps = n.next();
  ProjectionState<S> state;
  const Splat<S> splat = project(camera, to_camera(camera, n.vec()), unit, scale, eps, state);
  const SplatGrad<S> g{n.next(), n.next(), n.next(), {n.next(), n.next(), n.next(), n.next()}};
  const ProjectionGrad<S> grad = project_vjp(camera, unit, scale, eps, state, splat, g);
  n.put(grad.cam + grad.scale), n.put(grad.unit), n.put(grad.view[0][0]);
  const IntrinsicsGrad<S> lens = intrinsics_vjp(state, g, grad);
  n.put(lens.fx + lens.fy + lens.cx + lens.cy);
  const Extent<S> extent = visible_extent(splat, n.next(), Vec2<S>{camera.width, camera.height}, n.next(), n.next());
  n.put(extent.visible ? extent.x : extent.y);
  const Conic<S>& c = splat.conic;
  const Ellipse<S> e = visible_ellipse(splat.x, splat.y, c.u, c.w, c.v, n.next(), n.next());
  n.put(pixels_between(reach(e, n.next(), n.next(), S(-1)), reach(e, n.next(), n.next(), S(1)), 640).end);
  n.put(least_in_box(c.u, c.w, c.v, n.next(), n.next(), n.next(), n.next()));
}

template <class S>
__global__ void harmonics(Numbers<S> n) {
  S basis[kMaxShTerms];
  Vec3<S> by_direction;
  for (int degree = 0; degree <= 4; ++degree) {
    sh_basis(degree, n.next(), n.next(), n.next(), basis);
    sh_basis_vjp(degree, n.next(), n.next(), n.next(), basis, by_direction.x, by_direction.y, by_direction.z);
    n.put(by_direction);
  }
}

template <class S>
__global__ void blending(Numbers<S> n) {
  const BlendGaussian<S> g = blend_gaussian(n.in, n.in + 2, n.next());
  const S dx = g.x - n.next(), dy = g.y - n.next(), alpha_max = n.next();
  const S raw = exp2(log2_alpha(g, dx, dy, n.next(), n.next())), alpha = clamped_alpha(raw, alpha_max, raw > n.next());
  BlendStep<S> step = blend_step(alpha, n.next(), n.next());
  leave_full(n.next(), step);
  n.put(step.weight + slope_by_alpha(alpha, step.transmittance, n.next(), n.next(), n.next()));
  BlendBehind<S> behind{n.next(), n.next()};
  const BlendGrad<S> grad = blend_vjp(raw, alpha, alpha_max, n.next(), behind);
  n.put(slope_by_mean(grad.by_log_alpha, g.u, g.w, g.v, whitened(g.u, g.w, g.v, Vec2<S>{dx, dy}, dx, dy)).x);
  S moments[kBlendSums] = {grad.weight, n.next(), n.next(), n.next(), n.next(), n.next()}, about[kBlendSums];
  S sums[kBlendSums];
  moments_about(moments, dx, dy, about);
  blend_sums(about, double(g.u), double(g.w), double(g.v), {double(dx), double(dy)}, {double(dx), double(dy)}, sums);
  double total[kBlendSums];
  for (int k = 0; k < kBlendSums; ++k) total[k] = sums[k];
  n.put(splat_grad<S>(total, g.u, g.w, g.v, alpha, {double(dx), double(dy)}).mean.x);
}

template <class S>
__global__ void deformation(Numbers<S> n) {
  const Quat<S> q = n.quat();
  const Mat3<S> turn = turn_of(q);
  const Vec3<S> arm = n.vec(), columns[3] = {n.vec(), n.vec(), load_vec3(turn.m[0])};
  n.put(weight_exponent(arm, weight_decay<S>(double(n.next()))));
  n.put(moved_by(columns, n.vec(), arm));
  Vec3<S> by_columns[3] = {}, by_shift{}, by_point{};
  moved_by_vjp(columns, arm, n.vec(), by_columns, by_shift, by_point);
  n.put(by_columns[0] + by_shift + by_point), n.put(turn_vjp(q, turn));
  const S log_scales[3] = {n.next(), n.next(), n.next()};
  const Vec3<S> axis = shortest_axis(q, log_scales);
  n.put(reflected(contracted(arm), axis, dot(arm, axis)));
}

template <class S>
__global__ void posing(Numbers<S> n) {
  Mat3<S> linear = rotation_matrix(n.quat());
  const S logs[3] = {n.next(), n.next(), n.next()};
  const RestShape<S> shape = rest_shape(n.quat(), logs);
  const MovedShape<S> moved = move_shape(linear, shape);
  const MovedShapeGrad<S> by = move_shape_vjp(linear, shape, moved, n.quat(), moved.log_scales);
  n.put(moved.quat), n.put(by.quat), n.put(by.log_scales[0] + by.linear.m[0][0]);
  n.put(moved_point(linear, n.vec(), n.vec()) + moved_point_vjp(by.linear, n.vec(), n.vec(), linear));
}

template <class S>
__global__ void slicing(Numbers<S> n) {
  const S logs[4] = {n.next(), n.next(), n.next(), n.next()};
  const SpaceTime<S> f = space_time(n.quat(), n.quat(), logs);
  const SlicedShape<S> shape = sliced_shape(f);
  const S limit = n.next();
  const SliceGrad<S> g{n.vec(), n.quat(), {n.next(), n.next(), n.next()}, n.next()};
  const SpaceTimeGrad<S> by = slice_vjp(f, shape, n.next(), n.next(), limit, g);
  n.put(sliced_mean(by.mean, f.velocity, by.time)), n.put(by.left), n.put(by.right), n.put(log_deviation(f));
  const Wave<S> wave = first_wave(n.next());
  n.put(next_wave(wave, wave).sine);
}

template <class S>
__global__ void planes(Numbers<S> n) {
  const Cell<S> cell = locate(n.next(), 64);
  const TimeRows rows = time_rows(double(n.next()), 25);
  n.put(cell.index + cell.frac + S(rows.weight) + locate_vjp(n.next(), 64, n.next()));
  PlaneValue<S> plane[3];
  S value[3], line[3], g_plane[3], g_line[3], g[3], weight[4];
  for (int k = 0; k < 3; ++k) {
    plane[k] = bilinear_slopes(n.next(), n.next(), n.next(), n.next(), n.next(), n.next());
    value[k] = bilinear(n.next(), n.next(), n.next(), n.next(), n.next(), n.next());
    line[k] = lerp(n.next(), n.next(), n.next());
  }
  plane_product_vjp(plane, line, plane_product(value, line), g_plane, g_line);
  coordinate_vjp(plane, line, g_plane, g_line, g);
  bilinear_weights(g[0], g[1], weight);
  n.put(g[2] + weight[3] + second_difference(n.next(), n.next(), n.next()));
  n.put(second_difference_vjp(n.next(), n.next(), n.next(), n.next()) + distance_vjp(n.next(), n.next()));
}

// A field's samples as arrays that lie one after the other, and the sizes of its steps.
template <class S>
struct FieldArrays {
  S *densities, *colours, *starts, *ends;
  S transmittance_min, near, step, cone;
  FieldSpace<S> space;
  int64_t most;
};

template <class S>
__global__ void fields(Numbers<S> n, FieldArrays<S> in, const bool* occupied, bool* reached) {
  S coords[3][1] = {{n.next()}, {n.next()}, {n.next()}};
  HashCorners<1, S> corners;
  locate_hashed<1, S>({63, 64, 0, 1 << 14, false}, coords, corners);
  n.put(corners.weights[7][0] + static_cast<S>(corners.rows[5][0]));
  const S o[3] = {n.next(), n.next(), n.next()}, d[3] = {n.next(), n.next(), n.next()};
  RaySteps<S> steps(in, o, d, n.next());
  S start, end, x[3], unit[3];
  while (steps.next(in, occupied, start, end, x)) unit_coords(in.space, x, unit), n.put(unit[0] + end - start);
  const Sight<S> seen = composite_ray<S>(in, 0, 9, n.out);
  composite_ray_vjp(in, seen, 0, 9, n.out, n.out + 9);
  n.put(static_cast<S>(mark_reached<S>(in, 0, 9, reached)));
}

template <class S>
__global__ void training(Numbers<S> n) {
  const SsimTerms<S> t = ssim_terms(n.next(), n.next(), n.next(), n.next());
  n.put(sign(t.dissimilarity) + ssim_grad(n.next(), n.next(), t.grad_mean, t.grad_diff_square, t.grad_sum_square));
  const AdamCoefficients<S> c{n.next(), n.next(), n.next(), n.next(), n.next()};
  n.put(adam_update(AdamElement<S>{n.next(), n.next(), n.next()}, n.next(), n.next(), c).param);
}

template <class S>
void launch_all(Numbers<S> n) {
  rotations<<<1, 1>>>(n), projection<<<1, 1>>>(n), harmonics<<<1, 1>>>(n), blending<<<1, 1>>>(n);
  deformation<<<1, 1>>>(n), posing<<<1, 1>>>(n), slicing<<<1, 1>>>(n), planes<<<1, 1>>>(n);
  training<<<1, 1>>>(n);
  fields<<<1, 1>>>(n, FieldArrays<S>{}, nullptr, nullptr);
}
template void launch_all<float>(Numbers<float>);
template void launch_all<double>(Numbers<double>);

}  // namespace dyngs
