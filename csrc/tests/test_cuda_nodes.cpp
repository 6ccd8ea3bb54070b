// The CUDA kernels of control nodes and of the gradients by offsets, run by the emulation of cuda_on_cpu.hpp, or on a GPU: against
// the CPU's in float64.
#include <memory>
#include <tuple>

#include "tests/check.hpp"
#include "tests/gpu.hpp"

namespace {

using namespace dyngs;
using namespace check;

// The gradients by offsets of rows; `before`: the quaternions before they were turned.
void test_offset_gradients(bool picked, unsigned parts) {
  const int64_t n = 300, m = 270;
  const Values three = uniforms(3 * n, -1, 1), four = uniforms(4 * n, -1, 1), one = uniforms(n, -1, 1);
  const Values sh = uniforms(12 * n, -1, 1), before = uniforms(4 * n, -1, 1), offset = uniforms(4 * m, -1, 1);
  std::vector<int64_t> rows;
  for (int64_t i = 0; picked && i < m; ++i) rows.push_back((7 * i + 3) % n);
  const auto given = [parts](int bit, auto* array) { return (parts >> bit & 1) != 0 ? array : nullptr; };

  Values cpu[6] = {Values(3 * m), Values(4 * m), Values(3 * m), Values(m), Values(3 * m), four};
  add_offsets_backward<double>({m, picked ? rows.data() : nullptr, nullptr, offset.data(), nullptr, nullptr, nullptr},
                               before.data(),
                               {three.data(), given(1, three.data()), given(2, one.data()), given(3, sh.data()), 12,
                                cpu[0].data(), given(0, cpu[1].data()), given(1, cpu[2].data()),
                                given(2, cpu[3].data()), given(3, cpu[4].data()), given(0, cpu[5].data())},
                               1);
  Memory<float> by3(as<float>(three)), by1(as<float>(one)), by_sh(as<float>(sh)), own(as<float>(before));
  Memory<float> turned(as<float>(offset)), quats(as<float>(four));
  Memory<float> to3(as<float>(Values(3 * m))), to4(as<float>(Values(4 * m))), scales(as<float>(Values(3 * m)));
  Memory<float> to1(as<float>(Values(m))), colors(as<float>(Values(3 * m)));
  Memory<int64_t> which(rows);
  cuda::add_offsets_backward(
      {m, picked ? which.get() : nullptr, nullptr, turned.get(), nullptr, nullptr, nullptr}, own.get(),
      {by3.get(), given(1, by3.get()), given(2, by1.get()), given(3, by_sh.get()), 12, to3.get(), given(0, to4.get()),
       given(1, scales.get()), given(2, to1.get()), given(3, colors.get()), given(0, quats.get())},
      nullptr);
  const Memory<float>* gpu[6] = {&to3, &to4, &scales, &to1, &colors, &quats};
  for (int k = 0; k < 6; ++k)
    if (k == 0 || given(k % 5 == 0 ? 0 : k - 1, gpu[k]) != nullptr)
      expect_close("gradients by offsets of parts " + std::to_string(parts) + ", array " + std::to_string(k),
                   gpu[k]->values(), cpu[k], 1e-6);
}

// Control nodes -------------------------------------------------------------------------------------------------------

constexpr int64_t kHeadSizes[kHeads] = {3, 4, 3, 1, 3};

// Node poses at a time and gradients of their splines. `kept` is a bit mask of the heads.
void test_nodes(int64_t count, int64_t points, unsigned kept) {
  NodeSplines<double> splines{{}, count, points, points - 4, {0.1, 0.4, 0.3, 0.2}};
  NodeSplines<float> on_gpu{{}, count, points, points - 4, {0.1f, 0.4f, 0.3f, 0.2f}};
  SplineGrads<double> grads{};
  SplineGrads<float> gpu_grads{};
  std::vector<Values> heads(kHeads), found(kHeads);
  std::vector<std::unique_ptr<Memory<float>>> memory;
  const auto hold = [&](const Values& values) {
    memory.push_back(std::make_unique<Memory<float>>(as<float>(values)));
    return memory.back()->get();
  };
  int64_t width = 0;
  std::vector<size_t> places(kHeads);
  for (int h = 0; h < kHeads; ++h) {
    if ((kept >> h & 1) == 0) continue;
    heads[h] = uniforms(count * points * kHeadSizes[h], -1, 1), found[h] = Values(heads[h].size());
    splines.heads[h] = heads[h].data(), grads.heads[h] = found[h].data();
    on_gpu.heads[h] = hold(heads[h]), gpu_grads.heads[h] = hold(found[h]);
    places[h] = memory.size() - 1;
    width += h > 0 ? kHeadSizes[h] : 0;
  }
  Values motion(7 * count), values(width * count);
  nodes_at(splines, motion.data(), values.data(), 1);
  Memory<float> gpu_motion(as<float>(motion)), gpu_values(as<float>(values));
  cuda::nodes_at(on_gpu, gpu_motion.get(), gpu_values.get(), nullptr);
  const std::string what = std::to_string(count) + " nodes, heads " + std::to_string(kept);
  expect_close("motion of " + what, gpu_motion.values(), motion, 1e-6);
  if (width > 0) expect_close("values of " + what, gpu_values.values(), values, 1e-6);
  nodes_at_backward<double>(splines, motion.data(), values.data(), grads, 1);
  cuda::nodes_at_backward(on_gpu, gpu_motion.get(), gpu_values.get(), gpu_grads, nullptr);
  for (int h = 0; h < kHeads; ++h)
    if ((kept >> h & 1) != 0)
      expect_close("gradient by head " + std::to_string(h) + " of " + what, memory[places[h]]->values(), found[h],
                   1e-6);
}

void test_node_penalties(int64_t count, int64_t near, int64_t points) {
  const Values positions = uniforms(3 * count, -1, 1), radii = uniforms(count, 0.5, 1);
  const Values motion = uniforms(7 * count, -1, 1), paths = uniforms(3 * count * points, -1, 1);
  std::vector<int64_t> neighbours;
  neighbours.reserve(static_cast<size_t>(count * near));
  for (int64_t i = 0; i < count * near; ++i) neighbours.push_back((i * i + 1) % count);
  Values penalties(2), by_paths(paths.size()), by_motion(motion.size());
  node_penalties<double>(
      {positions.data(), radii.data(), neighbours.data(), motion.data(), paths.data(), count, near, points},
      penalties.data(), by_paths.data(), by_motion.data(), 1);
  Memory<float> at(as<float>(positions)), reach(as<float>(radii)), moves(as<float>(motion)), along(as<float>(paths));
  Memory<int64_t> near_by(neighbours);
  const NodeGraph<float> graph{at.get(), reach.get(), near_by.get(), moves.get(), along.get(), count, near, points};
  const std::string what = std::to_string(count) + " nodes with " + std::to_string(near) + " neighbours";
  const auto run = [&] {
    Memory<double> value(2);
    Memory<float> path_grads(as<float>(by_paths)), motion_grads(as<float>(by_motion));
    Memory<char> workspace(cuda::node_penalties_workspace(graph));
    cuda::node_penalties(graph, value.get(), path_grads.get(), motion_grads.get(), {workspace.get(), workspace.count()},
                         nullptr);
    return std::tuple{as<double>(value.values()), path_grads.values(), motion_grads.values()};
  };
  const auto gpu = run();
  expect_close("penalties of " + what, std::get<0>(gpu), penalties, 2e-6);
  expect_close("gradient by paths, " + what, std::get<1>(gpu), by_paths, 1e-5);
  expect_close("gradient by motion, " + what, std::get<2>(gpu), by_motion, 1e-5);
  in_other_orders([&] { expect(run() == gpu, "penalties in another order, " + what); });
}

}  // namespace

int main() {
  skip_without_gpu();
  for (const bool picked : {false, true})
    for (const unsigned parts : {0u, 1u, 2u, 4u, 8u, 15u}) test_offset_gradients(picked, parts);
  for (const unsigned kept : {1u, 3u, 29u, 31u}) test_nodes(150, 9, kept);
  test_node_penalties(300, 3, 9), test_node_penalties(2, 1, 4);
  return report();
}
