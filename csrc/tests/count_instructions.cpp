// Runs each training kernel once on a random scene and one thread, for benchmarks/instructions.py.
#include "tests/fields.hpp"
#include "tests/scene.hpp"
#include "tests/triangles.hpp"

namespace {

using namespace dyngs;
using namespace check;

using Floats = std::vector<float>;

Floats floats(int64_t count, double low, double high) { return as<float>(uniforms(count, low, high)); }

void images() {
  Scene scene = random_scene(20'000, 200, 160, 3, 0.02);
  scene.alpha_min = 1.0 / 255, scene.transmittance_min = 1e-4;
  const Cotangents cotangents = random_cotangents(scene);
  draw<float>(scene, 1, &cotangents);
}

void training() {
  const int64_t height = 160, width = 200, rows = 20'000, row_size = 48;
  const Floats shown = floats(3 * height * width, 0, 1), wanted = floats(3 * height * width, 0, 1);
  Floats gradient(shown.size());
  l1_ssim_loss({shown.data(), wanted.data(), nullptr, height, width, 0.2f}, gradient.data(), 1);
  Floats param = floats(rows * row_size, -1, 1), first = param, second(param.size());
  const Floats grad = floats(rows * row_size, -1, 1), rates(row_size, 0.01f);
  adam_step({param.data(), grad.data(), first.data(), second.data(), rows, row_size},
            {rates.data(), nullptr, 0.9, 0.999, 1e-15, 1}, 1);
}

void motion() {
  const int64_t nodes = 512, points = 33, gaussians = 20'000, per_point = 4, width = 10;
  std::vector<Floats> heads, grads;
  for (const int64_t size : {3, 4, 3, 3}) heads.push_back(floats(nodes * points * size, -1, 1));
  grads = heads;
  const NodeSplines<float> splines{{heads[0].data(), heads[1].data(), heads[2].data(), nullptr, heads[3].data()},
                                   nodes,
                                   points,
                                   7,
                                   {0.1f, 0.4f, 0.4f, 0.1f}};
  Floats moves(7 * nodes), values(width * nodes), by_moves(moves), by_values(values), by_paths(heads[0]);
  nodes_at(splines, moves.data(), values.data(), 1);
  const Floats positions = floats(3 * nodes, -1, 1), radii = floats(nodes, 0.1, 0.2);
  const Floats coords = floats(3 * gaussians, -1, 1);
  std::vector<int64_t> followed(gaussians * per_point), near(3 * nodes);
  for (size_t i = 0; i < followed.size(); ++i) followed[i] = static_cast<int64_t>(i * 37 % nodes);
  for (size_t i = 0; i < near.size(); ++i) near[i] = static_cast<int64_t>((i * 37 + 5) % nodes);
  Floats offset(3 * gaussians), blended(width * gaussians), weights(per_point * gaussians), by_points(3 * gaussians);
  const SkinNodes<float> skin{positions.data(), radii.data(), moves.data(), values.data(), nodes, width};
  const SkinPoints<float> follow{coords.data(), followed.data(), gaussians, per_point};
  skinning_forward<float>(skin, follow, {offset.data(), blended.data(), weights.data()}, 1);
  skinning_backward<float>(skin, follow, {offset.data(), blended.data(), weights.data()},
                           {by_points.data(), by_moves.data(), by_values.data()}, 1);
  double penalties[2];
  node_penalties<float>({positions.data(), radii.data(), near.data(), moves.data(), heads[0].data(), nodes, 3, points},
                        penalties, by_paths.data(), by_moves.data(), 1);
  nodes_at_backward<float>(splines, by_moves.data(), by_values.data(),
                           {{grads[0].data(), grads[1].data(), grads[2].data(), nullptr, grads[3].data()}}, 1);
}

void fields() {
  grid_on_cpu<float>(grid_case(levels_of({16, 64, 256}, 1 << 14), 4, 20'000));
  march_on_cpu<float>(march_case(2'000, 3, 0.01));
  composite_on_cpu<float>(sample_case(std::vector<int64_t>(2'000, 20), 0.5, 1e-4));
}

void triangles() {
  const PatchCase c = patch_case(2'000, 200, 160, 0.1);
  const auto shown = shown_on_cpu<float>(c);
  ends_on_cpu<float>(c, step_case(c, shown));
  blended_on_cpu<float>(image_case(c, shown, 4));
  values_on_cpu<float>(value_case(40'000, 2'000, 3, 0));
}

}  // namespace

int main() {
  images(), training(), motion(), fields(), triangles();
  return 0;
}
