// The CUDA kernels of moving Gaussians, run by the emulation of cuda_on_cpu.hpp with all its checks, or on a GPU
// (tests/GPU.hpp): against the CPU's in float64, and bit by bit against themselves under other orders of blocks and threads.
#include <memory>
#include <utility>

#include "tests/check.hpp"
#include "tests/gpu.hpp"

namespace {

using namespace dyngs;
using namespace check;

// Skinning ------------------------------------------------------------------------------------------------------------

struct SkinCase {
  int64_t nodes, width, points, per_point;
  Values positions, radii, motion, values, coords, g_offset, g_blended;
  std::vector<int64_t> followed;
};

SkinCase skin_case(int64_t nodes, int64_t width, int64_t points, int64_t per_point) {
  SkinCase c{nodes,
             width,
             points,
             per_point,
             uniforms(3 * nodes, -1, 1),
             uniforms(nodes, 0.2, 1),
             uniforms(7 * nodes, -1, 1),
             uniforms(nodes * width, -1, 1),
             uniforms(3 * points, -1, 1),
             uniforms(3 * points, -1, 1),
             uniforms(points * width, -1, 1),
             {}};
  for (int64_t i = 0; i < points * per_point; ++i) {
    const int64_t node =
        static_cast<int64_t>(uniform(0, 1) * static_cast<double>(nodes - 1));  // nobody follows the last
    c.followed.push_back(node);
  }
  if (nodes > 3)
    for (int k = 3; k < 7; ++k) c.motion[7 + k] = 0;  // the identity
  return c;
}

template <class S>
struct SkinResults {
  std::vector<S> offset, blended, weights, by_points, by_motion, by_values;
};

SkinResults<double> skin_on_cpu(const SkinCase& c) {
  SkinResults<double> r;
  r.offset.resize(3 * c.points), r.blended.resize(c.points * c.width), r.weights.resize(c.followed.size());
  r.by_points.resize(3 * c.points), r.by_motion.resize(7 * c.nodes), r.by_values.resize(c.nodes * c.width);
  const SkinNodes<double> nodes{c.positions.data(), c.radii.data(), c.motion.data(), c.values.data(), c.nodes, c.width};
  const SkinPoints<double> points{c.coords.data(), c.followed.data(), c.points, c.per_point};
  skinning_forward(nodes, points, {r.offset.data(), r.blended.data(), r.weights.data()}, 1);
  skinning_backward(nodes, points, {c.g_offset.data(), c.g_blended.data(), r.weights.data()},
                    {r.by_points.data(), r.by_motion.data(), r.by_values.data()}, 1);
  return r;
}

SkinResults<float> skin_on_gpu(const SkinCase& c, bool with_points = true) {
  Memory<float> positions(as<float>(c.positions), "positions"), radii(as<float>(c.radii), "radii");
  Memory<float> motion(as<float>(c.motion), "motion"), values(as<float>(c.values), "values");
  Memory<float> coords(as<float>(c.coords), "coords"), g_offset(as<float>(c.g_offset), "g_offset");
  Memory<float> g_blended(as<float>(c.g_blended), "g_blended");
  Memory<int64_t> followed(c.followed, "followed");
  Memory<float> offset(3 * c.points), blended(c.points * c.width), weights(c.points * c.per_point);
  Memory<float> by_points(3 * c.points), by_motion(7 * c.nodes), by_values(c.nodes * c.width);
  const SkinNodes<float> nodes{positions.get(), radii.get(), motion.get(), values.get(), c.nodes, c.width};
  const SkinPoints<float> points{coords.get(), followed.get(), c.points, c.per_point};
  Memory<char> forward(cuda::skinning_forward_workspace(c.nodes));
  Memory<char> backward(cuda::skinning_backward_workspace(c.nodes, c.points, c.per_point));
  cuda::skinning_forward(nodes, points, {offset.get(), blended.get(), weights.get()}, {forward.get(), forward.count()},
                         nullptr);
  cuda::skinning_backward(nodes, points, {g_offset.get(), g_blended.get(), weights.get()},
                          {with_points ? by_points.get() : nullptr, by_motion.get(), by_values.get()},
                          {backward.get(), backward.count()}, nullptr);
  return {offset.values(),    blended.values(),   weights.values(),
          by_points.values(), by_motion.values(), by_values.values()};
}

void test_skinning(int64_t nodes, int64_t width, int64_t points, int64_t per_point) {
  const SkinCase c = skin_case(nodes, width, points, per_point);
  const std::string what = std::to_string(points) + " points on " + std::to_string(nodes) + " nodes";
  const SkinResults<float> gpu = skin_on_gpu(c);
  const SkinResults<double> cpu = skin_on_cpu(c);
  expect_close("weights, " + what, gpu.weights, cpu.weights, 2e-6);
  expect_close("offset, " + what, gpu.offset, cpu.offset, 2e-6);
  expect_close("gradient by points, " + what, gpu.by_points, cpu.by_points, 2e-6);
  expect_close("gradient by motion, " + what, gpu.by_motion, cpu.by_motion, 1e-5);
  if (width > 0) {
    expect_close("blended, " + what, gpu.blended, cpu.blended, 2e-6);
    expect_close("gradient by values, " + what, gpu.by_values, cpu.by_values, 1e-5);
  }
  const auto expect_same = [&](const SkinResults<float>& again) {
    expect_same_bits("weights again, " + what, again.weights, gpu.weights);
    expect_same_bits("offset again, " + what, again.offset, gpu.offset);
    expect_same_bits("blended again, " + what, again.blended, gpu.blended);
    expect_same_bits("gradient by motion again, " + what, again.by_motion, gpu.by_motion);
    expect_same_bits("gradient by values again, " + what, again.by_values, gpu.by_values);
  };
  in_other_orders([&] { expect_same(skin_on_gpu(c)); });
  expect_same(skin_on_gpu(c, false));
}

// Points so far away that the squares of all distances overflow follow all nodes alike, as on the CPU.
void test_far_points() {
  SkinCase c = skin_case(6, 2, 20, 3);
  for (double& x : c.coords) x = static_cast<float>(x * 1e30);
  const SkinResults<float> gpu = skin_on_gpu(c);
  bool alike = true;
  for (float weight : gpu.weights) alike &= weight == 1.f / 3.f;
  expect(alike, "far points follow all nodes alike");
}

// Posing --------------------------------------------------------------------------------------------------------------

struct PosingCase {
  int64_t count, joints;
  Values means, quats, log_scales, weights, transforms, g_means, g_quats, g_log_scales, g_blended;
};

PosingCase posing_case(int64_t count, int64_t joints) {
  PosingCase c{count,
               joints,
               uniforms(3 * count, -1, 1),
               uniforms(4 * count, 0.3, 1),
               uniforms(3 * count, -4, -2),
               uniforms(count * joints, 0, 1),
               uniforms(12 * joints, -0.4, 0.4),
               uniforms(3 * count, -1, 1),
               uniforms(4 * count, -1, 1),
               uniforms(3 * count, -1, 1),
               uniforms(12 * count, -1, 1)};
  for (int64_t j = 0; j < joints; ++j)  // far from flat
    for (int k = 0; k < 3; ++k) c.transforms[12 * j + 5 * k] += 1;
  for (int64_t at = 0; at < count * joints; ++at)
    if ((at % joints + at / joints) % 4 != 0 && at % joints != at / joints % joints) c.weights[at] = 0;
  return c;
}

template <class S>
struct PosedCase {
  std::vector<S> means, quats, log_scales, blended, by_means, by_quats, by_log_scales, by_weights, by_transforms;
};

PosedCase<double> pose_on_cpu(const PosingCase& c) {
  PosedCase<double> r{c.means, c.quats,      c.log_scales, c.g_blended, c.means,
                      c.quats, c.log_scales, c.weights,    c.transforms};
  Values kept(12 * c.count);
  const Posing<double> in{c.count,          c.joints,           c.means.data(), c.quats.data(), c.log_scales.data(),
                          c.weights.data(), c.transforms.data()};
  pose_forward(in, {r.means.data(), r.quats.data(), r.log_scales.data(), r.blended.data(), kept.data()}, 1);
  pose_backward(
      in, {nullptr, r.quats.data(), nullptr, r.blended.data(), kept.data()},
      {c.g_means.data(), c.g_quats.data(), c.g_log_scales.data(), c.g_blended.data()},
      {r.by_means.data(), r.by_quats.data(), r.by_log_scales.data(), r.by_weights.data(), r.by_transforms.data()}, 1);
  return r;
}

// Without `all`: no gradient by the blended transforms, and none by the weights.
PosedCase<float> pose_on_gpu(const PosingCase& c, bool all = true) {
  Memory<float> means(as<float>(c.means)), quats(as<float>(c.quats)), log_scales(as<float>(c.log_scales));
  Memory<float> weights(as<float>(c.weights)), transforms(as<float>(c.transforms)), g_means(as<float>(c.g_means));
  Memory<float> g_quats(as<float>(c.g_quats)), g_logs(as<float>(c.g_log_scales)), g_blended(as<float>(c.g_blended));
  Memory<float> to_means(3 * c.count), to_quats(4 * c.count), to_logs(3 * c.count), blended(12 * c.count);
  Memory<float> kept(12 * c.count), by_means(3 * c.count), by_quats(4 * c.count), by_logs(3 * c.count);
  Memory<float> by_weights(c.count * c.joints), by_transforms(12 * c.joints);
  const Posing<float> in{c.count,          c.joints,      means.get(),     quats.get(),
                         log_scales.get(), weights.get(), transforms.get()};
  Memory<char> workspace(cuda::pose_backward_workspace(c.count, c.joints));
  cuda::pose_forward(in, {to_means.get(), to_quats.get(), to_logs.get(), blended.get(), kept.get()}, nullptr);
  cuda::pose_backward(
      in, {nullptr, to_quats.get(), nullptr, blended.get(), kept.get()},
      {g_means.get(), g_quats.get(), g_logs.get(), all ? g_blended.get() : nullptr},
      {by_means.get(), by_quats.get(), by_logs.get(), all ? by_weights.get() : nullptr, by_transforms.get()},
      {workspace.get(), workspace.count()}, nullptr);
  return {to_means.values(), to_quats.values(), to_logs.values(),    blended.values(),      by_means.values(),
          by_quats.values(), by_logs.values(),  by_weights.values(), by_transforms.values()};
}

void test_posing(int64_t count, int64_t joints) {
  const PosingCase c = posing_case(count, joints);
  const std::string what = std::to_string(count) + " Gaussians on " + std::to_string(joints) + " joints";
  const PosedCase<float> gpu = pose_on_gpu(c);
  const PosedCase<double> cpu = pose_on_cpu(c);
  expect_close("posed means, " + what, gpu.means, cpu.means, 2e-6);
  expect_close("posed quaternions, " + what, gpu.quats, cpu.quats, 2e-5);
  expect_close("posed scales, " + what, gpu.log_scales, cpu.log_scales, 2e-6);
  expect_close("blended transforms, " + what, gpu.blended, cpu.blended, 2e-6);
  expect_close("gradient by means at rest, " + what, gpu.by_means, cpu.by_means, 1e-5);
  expect_close("gradient by quaternions at rest, " + what, gpu.by_quats, cpu.by_quats, 1e-4);
  expect_close("gradient by scales at rest, " + what, gpu.by_log_scales, cpu.by_log_scales, 1e-4);
  expect_close("gradient by weights, " + what, gpu.by_weights, cpu.by_weights, 1e-4);
  expect_close("gradient by transforms, " + what, gpu.by_transforms, cpu.by_transforms, 1e-4);
  in_other_orders([&] {
    const PosedCase<float> again = pose_on_gpu(c);
    expect_same_bits("posed quaternions again, " + what, again.quats, gpu.quats);
    expect_same_bits("gradient by scales again, " + what, again.by_log_scales, gpu.by_log_scales);
    expect_same_bits("gradient by weights again, " + what, again.by_weights, gpu.by_weights);
    expect_same_bits("gradient by transforms again, " + what, again.by_transforms, gpu.by_transforms);
  });
  expect_same_bits("gradient by scales alone, " + what, pose_on_gpu(c, false).by_log_scales, gpu.by_log_scales);
}

void test_no_gaussians_posed() {
  const PosedCase<float> gpu = pose_on_gpu(posing_case(0, 3));
  expect(std::all_of(gpu.by_transforms.begin(), gpu.by_transforms.end(), [](float x) { return x == 0; }),
         "no Gaussians, no gradients by transforms");
}

// Slicing -------------------------------------------------------------------------------------------------------------

// Of all inputs, of the slice, and of the gradients by the inputs, in the order of the structs.
using Parts = std::vector<Values>;
constexpr int64_t kInputs[] = {3, 1, 4, 4, 3, 1, 1}, kSliced[] = {3, 4, 3, 1, 12};

struct SlicingCase {
  int64_t count;
  Parts inputs, g;
};

SlicingCase slicing_case(int64_t count) {
  SlicingCase c{count, {}, {}};
  for (const int64_t size : kInputs) c.inputs.push_back(uniforms(size * count, -1, 1));
  for (const int64_t size : kSliced) c.g.push_back(uniforms(size * count, -1, 1));
  for (int64_t i = 0; i < 3 * count; ++i) c.inputs[4][i] -= i % 3;  // far from equal
  for (int64_t i = 0; i < count; ++i) c.inputs[5][i] = -std::abs(c.inputs[5][i]);
  return c;
}

template <class S, class Arrays>
SpaceTimeGaussians<S> slicing_input(int64_t count, const Arrays& x) {
  return {count, x(0), x(1), x(2), x(3), x(4), x(5), x(6)};
}

Parts slice_on_cpu(const SlicingCase& c, const SliceTime<double>& at) {
  Parts r;
  for (const int64_t size : kSliced) r.push_back(Values(size * c.count));
  for (const int64_t size : kInputs) r.push_back(Values(size * c.count));
  for (const int64_t size : {4, 3, 3, 1}) r.push_back(Values(size * c.count));
  const auto in = slicing_input<double>(c.count, [&](int k) { return c.inputs[k].data(); });
  const auto to = [&](int k) { return r[k].data(); };
  slice_forward<double>(in, at, {to(0), to(1), to(2), to(3), to(4)}, 1);
  slice_backward<double>(in, at, {to(0), to(1), to(2), to(3), to(4)},
                         {c.g[0].data(), c.g[1].data(), c.g[2].data(), c.g[3].data()},
                         {to(5), to(6), to(7), to(8), to(9), to(10), to(11)}, 1);
  condition<double>(in, {to(12), to(13), to(14), to(15)}, 1);
  return r;
}

std::vector<std::vector<float>> slice_on_gpu(const SlicingCase& c, const SliceTime<float>& at) {
  std::vector<std::unique_ptr<Memory<float>>> inputs, g, r;
  for (const Values& x : c.inputs) inputs.push_back(std::make_unique<Memory<float>>(as<float>(x)));
  for (const Values& x : c.g) g.push_back(std::make_unique<Memory<float>>(as<float>(x)));
  for (const int64_t size : {3, 4, 3, 1, 12, 3, 1, 4, 4, 3, 1, 1, 4, 3, 3, 1})
    r.push_back(std::make_unique<Memory<float>>(size * c.count));
  const auto in = slicing_input<float>(c.count, [&](int k) { return inputs[k]->get(); });
  const auto to = [&](int k) { return r[k]->get(); };
  cuda::slice_forward(in, at, {to(0), to(1), to(2), to(3), to(4)}, nullptr);
  cuda::slice_backward(in, at, {to(0), to(1), to(2), to(3), to(4)},
                       {g[0]->get(), g[1]->get(), g[2]->get(), g[3]->get()},
                       {to(5), to(6), to(7), to(8), to(9), to(10), to(11)}, nullptr);
  cuda::condition(in, {to(12), to(13), to(14), to(15)}, nullptr);
  std::vector<std::vector<float>> values;
  values.reserve(r.size());
  for (const auto& x : r) values.push_back(x->values());
  return values;
}

void test_slicing(int64_t count) {
  const char* const names[] = {"sliced means",
                               "sliced quaternions",
                               "sliced scales",
                               "sliced logits",
                               "bases of slices",
                               "gradient by means of slices",
                               "gradient by times",
                               "gradient by left quaternions",
                               "gradient by right quaternions",
                               "gradient by scales of slices",
                               "gradient by spans",
                               "gradient by logits of slices",
                               "conditional quaternions",
                               "conditional scales",
                               "velocities",
                               "deviations of time"};
  const SlicingCase c = slicing_case(count);
  const auto gpu = slice_on_gpu(c, {0.3f, 3.f});
  const Parts cpu = slice_on_cpu(c, {0.3f, 3.});
  for (size_t k = 0; k < gpu.size(); ++k)
    expect_close(std::string(names[k]) + " of " + std::to_string(count), gpu[k], cpu[k], 1e-4);
  in_other_orders([&] {
    const auto again = slice_on_gpu(c, {0.3f, 3.f});
    for (size_t k = 0; k < gpu.size(); ++k) expect_same_bits(std::string(names[k]) + " again", again[k], gpu[k]);
  });
}

// Planes --------------------------------------------------------------------------------------------------------------

struct PlaneCase {
  int64_t channels, points;
  double time;
  std::vector<std::pair<int64_t, int64_t>> sizes;  // size and times of each level
  std::vector<Values> space, lines;
  Values coords, g_features;
};

PlaneCase plane_case(int64_t channels, int64_t points, double time, std::vector<std::pair<int64_t, int64_t>> sizes) {
  PlaneCase c{channels, points, time, std::move(sizes), {}, {}, uniforms(3 * points, -1.2, 1.2), {}};
  for (const auto& [size, times] : c.sizes) {
    c.space.push_back(uniforms(3 * size * size * channels, 0.5, 1.5));
    c.lines.push_back(uniforms(3 * times * size * channels, 0.5, 1.5));
  }
  c.g_features = uniforms(points * channels * static_cast<int64_t>(c.sizes.size()), -1, 1);
  return c;
}

template <class S>
struct PlaneResults {
  std::vector<S> features, g_coords;
  std::vector<std::vector<S>> g_space, g_time;
};

PlaneResults<double> planes_on_cpu(const PlaneCase& c) {
  PlaneResults<double> r;
  std::vector<PlaneLevel<double>> levels;
  std::vector<PlaneGrads<double>> grads;
  for (size_t l = 0; l < c.sizes.size(); ++l)
    r.g_space.emplace_back(c.space[l].size()), r.g_time.emplace_back(c.lines[l].size());
  for (size_t l = 0; l < c.sizes.size(); ++l) {
    levels.push_back({c.space[l].data(), c.lines[l].data(), c.sizes[l].first, c.sizes[l].second});
    grads.push_back({r.g_space[l].data(), r.g_time[l].data()});
  }
  std::vector<int32_t> order(c.points);
  r.features.resize(c.g_features.size()), r.g_coords.resize(c.coords.size());
  const HexPlane<double> planes{levels, c.channels, c.time};
  const PlanePoints<double> points{c.coords.data(), c.points};
  hexplane_forward(planes, points, r.features.data(), order.data(), 1);
  hexplane_backward<double>(planes, points, order.data(), c.g_features.data(), grads, r.g_coords.data(), 1);
  return r;
}

PlaneResults<float> planes_on_gpu(const PlaneCase& c, bool with_coords = true) {
  std::vector<std::unique_ptr<Memory<float>>> arrays;
  const auto hold = [&arrays](auto&&... arguments) {
    arrays.push_back(std::make_unique<Memory<float>>(arguments...));
    return arrays.back()->get();
  };
  std::vector<PlaneLevel<float>> levels;
  std::vector<PlaneGrads<float>> grads;
  for (size_t l = 0; l < c.sizes.size(); ++l) {
    levels.push_back({hold(as<float>(c.space[l])), hold(as<float>(c.lines[l])), c.sizes[l].first, c.sizes[l].second});
    float* g_space = hold(static_cast<int64_t>(c.space[l].size()));
    grads.push_back({g_space, hold(static_cast<int64_t>(c.lines[l].size()))});
  }
  const HexPlane<float> planes{levels, c.channels, c.time};
  Memory<float> coords(as<float>(c.coords), "coords"), g_features(as<float>(c.g_features), "g_features");
  Memory<float> features(g_features.count()), g_coords(coords.count());
  Memory<char> forward(cuda::hexplane_forward_workspace(planes));
  Memory<char> backward(cuda::hexplane_backward_workspace(planes, c.points));
  const PlanePoints<float> points{coords.get(), c.points};
  cuda::hexplane_forward(planes, points, features.get(), {forward.get(), forward.count()}, nullptr);
  cuda::hexplane_backward(planes, points, g_features.get(), grads, with_coords ? g_coords.get() : nullptr,
                          {backward.get(), backward.count()}, nullptr);
  PlaneResults<float> r{features.values(), g_coords.values(), {}, {}};
  for (size_t l = 0; l < c.sizes.size(); ++l)
    r.g_space.push_back(arrays[4 * l + 2]->values()), r.g_time.push_back(arrays[4 * l + 3]->values());
  return r;
}

void test_planes(const std::string& what, const PlaneCase& c) {
  const PlaneResults<float> gpu = planes_on_gpu(c);
  const PlaneResults<double> cpu = planes_on_cpu(c);
  expect_close("features, " + what, gpu.features, cpu.features, 2e-6);
  expect_close("gradient by coordinates, " + what, gpu.g_coords, cpu.g_coords, 1e-5);
  for (size_t l = 0; l < c.sizes.size(); ++l) {
    expect_close("gradient by planes over space, " + what, gpu.g_space[l], cpu.g_space[l], 1e-5);
    expect_close("gradient by planes over time, " + what, gpu.g_time[l], cpu.g_time[l], 1e-5);
  }
  const auto expect_same = [&](const PlaneResults<float>& again) {
    expect_same_bits("features again, " + what, again.features, gpu.features);
    for (size_t l = 0; l < c.sizes.size(); ++l) {
      expect_same_bits("gradient by planes over space again, " + what, again.g_space[l], gpu.g_space[l]);
      expect_same_bits("gradient by planes over time again, " + what, again.g_time[l], gpu.g_time[l]);
    }
  };
  in_other_orders([&] { expect_same(planes_on_gpu(c)); });
  expect_same(planes_on_gpu(c, false));
}

void test_no_points() {
  const PlaneCase c = plane_case(2, 0, 0.5, {{3, 2}});
  const PlaneResults<float> gpu = planes_on_gpu(c);
  const auto is_zero = [](float x) { return x == 0; };
  expect(std::all_of(gpu.g_space[0].begin(), gpu.g_space[0].end(), is_zero) &&
             std::all_of(gpu.g_time[0].begin(), gpu.g_time[0].end(), is_zero),
         "no points, no gradients");
}

struct Penalty {
  double value;
  std::vector<Values> g_space, g_time;
};

constexpr PenaltyWeights kWeights{0.3, 0.2, 0.1};

Penalty penalty_on_cpu(const PlaneCase& c) {
  Penalty r{0, {}, {}};
  std::vector<PlaneLevel<double>> levels;
  std::vector<PlaneGrads<double>> grads;
  for (size_t l = 0; l < c.sizes.size(); ++l)
    r.g_space.emplace_back(c.space[l].size()), r.g_time.emplace_back(c.lines[l].size());
  for (size_t l = 0; l < c.sizes.size(); ++l) {
    levels.push_back({c.space[l].data(), c.lines[l].data(), c.sizes[l].first, c.sizes[l].second});
    grads.push_back({r.g_space[l].data(), r.g_time[l].data()});
  }
  r.value = plane_penalty<double>({levels, c.channels, c.time}, kWeights, grads, 1);
  return r;
}

// Without gradients, `space` and `time` of the result are empty.
Penalty penalty_on_gpu(const PlaneCase& c, bool with_gradients) {
  std::vector<std::unique_ptr<Memory<float>>> arrays;
  const auto hold = [&arrays](auto&&... arguments) {
    arrays.push_back(std::make_unique<Memory<float>>(arguments...));
    return arrays.back()->get();
  };
  std::vector<PlaneLevel<float>> levels;
  std::vector<PlaneGrads<float>> grads;
  for (size_t l = 0; l < c.sizes.size(); ++l) {
    levels.push_back({hold(as<float>(c.space[l])), hold(as<float>(c.lines[l])), c.sizes[l].first, c.sizes[l].second});
    if (!with_gradients) continue;
    float* g_space = hold(static_cast<int64_t>(c.space[l].size()));
    grads.push_back({g_space, hold(static_cast<int64_t>(c.lines[l].size()))});
  }
  const HexPlane<float> planes{levels, c.channels, c.time};
  Memory<double> value(1);
  Memory<char> workspace(cuda::plane_penalty_workspace(planes));
  cuda::plane_penalty(planes, kWeights, grads, value.get(), {workspace.get(), workspace.count()}, nullptr);
  Penalty r{value.values()[0], {}, {}};
  for (size_t l = 0; l < c.sizes.size() && with_gradients; ++l) {
    r.g_space.push_back(as<double>(arrays[4 * l + 2]->values()));
    r.g_time.push_back(as<double>(arrays[4 * l + 3]->values()));
  }
  return r;
}

void test_penalty(const PlaneCase& c) {
  const Penalty gpu = penalty_on_gpu(c, true), cpu = penalty_on_cpu(c);
  const std::string what = "planes of " + std::to_string(c.sizes[0].first);
  expect_close("penalty, " + what, Values{gpu.value}, Values{cpu.value}, 2e-6);
  for (size_t l = 0; l < c.sizes.size(); ++l) {
    if (c.sizes[l].first > 2)
      expect_close("gradient of the penalty, space, " + what, gpu.g_space[l], cpu.g_space[l], 2e-5);
    expect_close("gradient of the penalty, time, " + what, gpu.g_time[l], cpu.g_time[l], 2e-5);
  }
  expect(penalty_on_gpu(c, false).value == gpu.value, "the penalty without its gradient, " + what);
  in_other_orders([&] {
    const Penalty again = penalty_on_gpu(c, true);
    expect(again.value == gpu.value && again.g_time == gpu.g_time, "the penalty in another order, " + what);
  });
}

// Offsets -------------------------------------------------------------------------------------------------------------

// Adds offsets to the rows `rows`, or the first ones; `parts`: which offsets there are, bit by bit.
void test_offsets(bool picked, unsigned parts) {
  const int64_t n = 300, m = 270;
  const Values means = uniforms(3 * n, -1, 1), quats = uniforms(4 * n, -1, 1), scales = uniforms(3 * n, -1, 1);
  const Values opacities = uniforms(n, -1, 1), sh = uniforms(12 * n, -1, 1);
  const Values d3 = uniforms(3 * m, -1, 1), d4 = uniforms(4 * m, -1, 1), d1 = uniforms(m, -1, 1);
  std::vector<int64_t> rows;
  for (int64_t i = 0; picked && i < m; ++i) rows.push_back((7 * i + 3) % n);  // 7 and 300 have no common factor
  const auto given = [parts](int bit, const auto* array) { return (parts >> bit & 1) != 0 ? array : nullptr; };

  Values cpu[5] = {means, quats, scales, opacities, sh};
  add_offsets<double>({m, picked ? rows.data() : nullptr, d3.data(), given(0, d4.data()), given(1, d3.data()),
                       given(2, d1.data()), given(3, d3.data())},
                      {cpu[0].data(), cpu[1].data(), cpu[2].data(), cpu[3].data(), cpu[4].data(), 12}, 1);
  Memory<float> on_gpu[5] = {Memory<float>(as<float>(means)), Memory<float>(as<float>(quats)),
                             Memory<float>(as<float>(scales)), Memory<float>(as<float>(opacities)),
                             Memory<float>(as<float>(sh))};
  Memory<float> by3(as<float>(d3)), by4(as<float>(d4)), by1(as<float>(d1));
  Memory<int64_t> which(rows);
  const auto* three = by3.get();
  cuda::add_offsets({m, picked ? which.get() : nullptr, three, given(0, by4.get()), given(1, three),
                     given(2, by1.get()), given(3, three)},
                    {on_gpu[0].get(), on_gpu[1].get(), on_gpu[2].get(), on_gpu[3].get(), on_gpu[4].get(), 12}, nullptr);
  for (int k = 0; k < 5; ++k)
    expect_close("offsets of parts " + std::to_string(parts) + ", array " + std::to_string(k), on_gpu[k].values(),
                 cpu[k], 1e-6);
}

// Shading -------------------------------------------------------------------------------------------------------------

void test_shading(bool normals, bool timed, bool posed) {
  const int64_t n = 90, m = 200;
  const Values means = uniforms(3 * n, -3, 3), quats = uniforms(4 * n, -1, 1), scales = uniforms(3 * n, -3, 0);
  const Values base = uniforms(3 * m, 0, 1), eye = uniforms(3, 4, 5), box = uniforms(6, 1, 2);
  const Values places = uniforms(3 * n, -3, 3), turn{0, -1, 0, 1, 0, 0, 0, 0, 1};
  std::vector<int64_t> picked(m);
  for (int64_t i = 0; i < m; ++i) picked[i] = (37 * i) % n;
  Shading<double> in{m,          picked.data(), means.data(), quats.data(), scales.data(), base.data(), eye.data(),
                     box.data(), nullptr,       nullptr,      normals,      timed,         0.25,        1};
  if (posed) in.places = places.data(), in.turn = turn.data();
  Values cpu(m * in.width());
  shading_inputs(in, cpu.data());
  Memory<float> on_gpu[8] = {Memory<float>(as<float>(means)),  Memory<float>(as<float>(quats)),
                             Memory<float>(as<float>(scales)), Memory<float>(as<float>(base)),
                             Memory<float>(as<float>(eye)),    Memory<float>(as<float>(box)),
                             Memory<float>(as<float>(places)), Memory<float>(as<float>(turn))};
  Memory<int64_t> which(picked);
  Memory<float> out(m * in.width());
  cuda::shading_inputs(
      {m, which.get(), on_gpu[0].get(), on_gpu[1].get(), on_gpu[2].get(), on_gpu[3].get(), on_gpu[4].get(),
       on_gpu[5].get(), posed ? on_gpu[6].get() : nullptr, posed ? on_gpu[7].get() : nullptr, normals, timed, 0.25f, 1},
      out.get(), nullptr);
  expect_close("inputs of the colour network, width " + std::to_string(in.width()), out.values(), cpu, 2e-6);
}

}  // namespace

int main() {
  skip_without_gpu();
  test_skinning(5, 3, 40, 3), test_skinning(300, 7, 500, 4), test_skinning(2, 0, 300, 1);
  test_far_points();
  test_posing(1, 1), test_posing(150, 24), test_posing(700, 3), test_no_gaussians_posed();
  test_slicing(1), test_slicing(300), slice_on_gpu(slicing_case(0), {0, 3});
  test_planes("two levels", plane_case(5, 150, 0.37, {{7, 4}, {17, 3}}));
  test_planes("more channels than a warp has lanes", plane_case(40, 60, 1, {{4, 5}}));
  test_planes("one sample", plane_case(3, 30, 0, {{1, 1}, {2, 2}}));
  test_no_points();
  test_penalty(plane_case(5, 1, 0, {{9, 6}, {4, 2}})), test_penalty(plane_case(3, 1, 0, {{2, 1}, {1, 3}}));
  for (const bool picked : {false, true})
    for (const unsigned parts : {0u, 1u, 2u, 4u, 8u, 15u}) test_offsets(picked, parts);
  for (const bool normals : {false, true})
    for (const bool timed : {false, true}) test_shading(normals, timed, false), test_shading(normals, timed, true);
  return report();
}
