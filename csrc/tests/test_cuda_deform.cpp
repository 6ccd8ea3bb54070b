// The CUDA kernels of moving Gaussians, run by the emulation of cuda_on_cpu.hpp with all its checks, or on a card
// (tests/card.hpp): against the CPU's in float64, and bit by bit against themselves under other orders of blocks and threads.
#include <limits>

#include "tests/card.hpp"
#include "tests/check.hpp"

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

SkinResults<float> skin_on_card(const SkinCase& c, bool with_points = true) {
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
  const SkinResults<float> card = skin_on_card(c);
  const SkinResults<double> cpu = skin_on_cpu(c);
  expect_close("weights, " + what, card.weights, cpu.weights, 2e-6);
  expect_close("offset, " + what, card.offset, cpu.offset, 2e-6);
  expect_close("gradient by points, " + what, card.by_points, cpu.by_points, 2e-6);
  expect_close("gradient by motion, " + what, card.by_motion, cpu.by_motion, 1e-5);
  if (width > 0) {
    expect_close("blended, " + what, card.blended, cpu.blended, 2e-6);
    expect_close("gradient by values, " + what, card.by_values, cpu.by_values, 1e-5);
  }
  const auto expect_same = [&](const SkinResults<float>& again) {
    expect_same_bits("weights again, " + what, again.weights, card.weights);
    expect_same_bits("offset again, " + what, again.offset, card.offset);
    expect_same_bits("blended again, " + what, again.blended, card.blended);
    expect_same_bits("gradient by motion again, " + what, again.by_motion, card.by_motion);
    expect_same_bits("gradient by values again, " + what, again.by_values, card.by_values);
  };
  in_other_orders([&] { expect_same(skin_on_card(c)); });
  expect_same(skin_on_card(c, false));
}

// Points so far away that the squares of all distances overflow follow all nodes alike, as on the CPU.
void test_far_points() {
  SkinCase c = skin_case(6, 2, 20, 3);
  for (double& x : c.coords) x = static_cast<float>(x * 1e30);
  const SkinResults<float> card = skin_on_card(c);
  bool alike = true;
  for (float weight : card.weights) alike &= weight == 1.f / 3.f;
  expect(alike, "far points follow all nodes alike");
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
  Memory<float> on_card[5] = {Memory<float>(as<float>(means)), Memory<float>(as<float>(quats)),
                              Memory<float>(as<float>(scales)), Memory<float>(as<float>(opacities)),
                              Memory<float>(as<float>(sh))};
  Memory<float> by3(as<float>(d3)), by4(as<float>(d4)), by1(as<float>(d1));
  Memory<int64_t> which(rows);
  const auto* three = by3.get();
  cuda::add_offsets({m, picked ? which.get() : nullptr, three, given(0, by4.get()), given(1, three),
                     given(2, by1.get()), given(3, three)},
                    {on_card[0].get(), on_card[1].get(), on_card[2].get(), on_card[3].get(), on_card[4].get(), 12},
                    nullptr);
  for (int k = 0; k < 5; ++k)
    expect_close("offsets of parts " + std::to_string(parts) + ", array " + std::to_string(k), on_card[k].values(),
                 cpu[k], 1e-6);
}

// Shading -------------------------------------------------------------------------------------------------------------

void test_shading(bool normals, bool timed, bool posed) {
  const int64_t n = 90, m = 200;
  const Values means = uniforms(3 * n, -3, 3), quats = uniforms(4 * n, -1, 1), scales = uniforms(3 * n, -3, 0);
  const Values base = uniforms(3 * m, 0, 1), eye = uniforms(3, 4, 5), box = uniforms(6, 1, 2);
  const Values places = uniforms(3 * n, -3, 3), turn{0, -1, 0, 1, 0, 0, 0, 0, 1};
  std::vector<int64_t> picked;
  for (int64_t i = 0; i < m; ++i) picked.push_back((37 * i) % n);
  Shading<double> in{m,          picked.data(), means.data(), quats.data(), scales.data(), base.data(), eye.data(),
                     box.data(), nullptr,       nullptr,      normals,      timed,         0.25,        1};
  if (posed) in.places = places.data(), in.turn = turn.data();
  Values cpu(m * in.width());
  shading_inputs(in, cpu.data());
  Memory<float> on_card[8] = {Memory<float>(as<float>(means)),  Memory<float>(as<float>(quats)),
                              Memory<float>(as<float>(scales)), Memory<float>(as<float>(base)),
                              Memory<float>(as<float>(eye)),    Memory<float>(as<float>(box)),
                              Memory<float>(as<float>(places)), Memory<float>(as<float>(turn))};
  Memory<int64_t> which(picked);
  Memory<float> out(m * in.width());
  cuda::shading_inputs({m, which.get(), on_card[0].get(), on_card[1].get(), on_card[2].get(), on_card[3].get(),
                        on_card[4].get(), on_card[5].get(), posed ? on_card[6].get() : nullptr,
                        posed ? on_card[7].get() : nullptr, normals, timed, 0.25f, 1},
                       out.get(), nullptr);
  expect_close("inputs of the colour network, width " + std::to_string(in.width()), out.values(), cpu, 2e-6);
}

}  // namespace

int main() {
  skip_without_card();
  test_skinning(5, 3, 40, 3), test_skinning(300, 7, 500, 4), test_skinning(2, 0, 300, 1);
  test_far_points();
  for (const bool picked : {false, true})
    for (const unsigned parts : {0u, 1u, 2u, 4u, 8u, 15u}) test_offsets(picked, parts);
  for (const bool normals : {false, true})
    for (const bool timed : {false, true}) test_shading(normals, timed, false), test_shading(normals, timed, true);
  return report();
}
