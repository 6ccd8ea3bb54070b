// The CUDA kernels of curved triangles, run by the emulation of cuda_on_cpu.hpp with all its checks, or on a GPU: against the CPU's,
// and bit by bit against themselves under other orders of blocks and threads.
#include <algorithm>
#include <limits>

#include "tests/gpu.hpp"
#include "tests/triangles.hpp"

namespace {

using namespace dyngs;
using namespace check;

ValueResults<float> values_on_gpu(const ValueCase& c) {
  Memory<int32_t> ids(c.ids);
  Memory<float> uv(as<float>(c.uv)), values(as<float>(c.values)), g_out(as<float>(c.g_out));
  Memory<float> out(g_out.count()), g_values(values.count());
  PatchPlaces places = c.places(1);
  places.ids = ids.get();
  Memory<char> workspace(cuda::patch_values_backward_workspace(places));
  cuda::patch_values_forward(places, uv.get(), values.get(), out.get(), nullptr);
  cuda::patch_values_backward(places, uv.get(), g_out.get(), g_values.get(), {workspace.get(), workspace.count()},
                              nullptr);
  return {out.values(), g_values.values()};
}

void test_values(int64_t count, int64_t patches, int64_t channels, int basis) {
  const ValueCase c = value_case(count, patches, channels, basis);
  const std::string what = ", basis " + std::to_string(basis);
  const auto cpu = values_on_cpu<double>(c);
  const auto gpu = values_on_gpu(c);
  expect_close("values" + what, gpu.out, cpu.out, 1e-5);
  expect_close("gradient" + what, gpu.g_values, cpu.g_values, 1e-5);
  in_other_orders([&] {
    const auto again = values_on_gpu(c);
    expect_same_bits("values again" + what, again.out, gpu.out);
    expect_same_bits("gradient again" + what, again.g_values, gpu.g_values);
  });
}

void test_no_samples() {
  const auto gpu = values_on_gpu(value_case(0, 5, 3, 0));
  expect(std::all_of(gpu.g_values.begin(), gpu.g_values.end(), [](float x) { return x == 0; }), "no places");
}

Shown<float> shown_on_gpu(const PatchCase& c) {
  Memory<float> points(as<float>(c.points)), viewmats(as<float>(c.viewmats)), intrinsics(as<float>(c.intrinsics));
  Memory<int32_t> ids(c.pixels());
  Memory<float> uv(2 * c.pixels());
  const PatchViews<float> in{points.get(),
                             viewmats.get(),
                             intrinsics.get(),
                             c.patches(),
                             c.views(),
                             c.width,
                             c.height,
                             c.segments,
                             static_cast<float>(c.near),
                             1};
  Memory<char> workspace(cuda::visible_patches_workspace(in));
  cuda::visible_patches(in, {ids.get(), uv.get()}, {workspace.get(), workspace.count()}, nullptr);
  return {ids.values(), uv.values()};
}

void test_visible_patches(int64_t patches, int width, int height, double size) {
  PatchCase c = patch_case(patches, width, height, size);
  if (patches > 2) c.points[7] = std::numeric_limits<double>::quiet_NaN();
  const auto cpu = shown_on_cpu<float>(c), gpu = shown_on_gpu(c);
  const std::string what = ", " + std::to_string(patches) + " patches";
  int64_t other = 0;
  for (int64_t i = 0; i < c.pixels(); ++i) {
    other += gpu.ids[i] != cpu.ids[i] ? 1 : 0;
    for (int k = 0; k < 2 && gpu.ids[i] == cpu.ids[i]; ++k)
      expect(std::abs(gpu.uv[2 * i + k] - cpu.uv[2 * i + k]) < 1e-4f, "where on a patch" + what);
  }
  expect(other <= c.pixels() / 500, std::to_string(other) + " pixels show another patch" + what);
  in_other_orders([&] {
    const auto again = shown_on_gpu(c);
    expect(again.ids == gpu.ids, "what is shown again" + what);
    expect_same_bits("places again" + what, again.uv, gpu.uv);
  });
}

Ends<float> ends_on_gpu(const PatchCase& c, const StepCase& from) {
  Memory<float> points(as<float>(c.points)), viewmats(as<float>(c.viewmats)), intrinsics(as<float>(c.intrinsics));
  Memory<float> uv(as<float>(from.uv)), steps(from.count()), places(2 * from.count()), slopes(2 * from.count());
  Memory<int32_t> views(from.views), ids(from.ids), directions(from.directions);
  Memory<bool> found(from.count());
  cuda::patch_ends({points.get(), viewmats.get(), intrinsics.get(), views.get(), ids.get(), directions.get(), uv.get(),
                    from.count(), 1},
                   {found.get(), steps.get(), places.get(), slopes.get()}, nullptr);
  const auto which = found.values();
  return {{which.begin(), which.end()}, steps.values(), places.values(), slopes.values()};
}

void test_outlines() {
  const PatchCase c = patch_case(9, 40, 30, 0.5);
  const auto from = step_case(c, shown_on_cpu<float>(c));
  const auto cpu = ends_on_cpu<float>(c, from), gpu = ends_on_gpu(c, from);
  int64_t found = 0, other = 0;
  for (int64_t n = 0; n < from.count(); ++n) {
    other += gpu.found[n] != cpu.found[n] ? 1 : 0, found += gpu.found[n];
    if (gpu.found[n] == cpu.found[n]) expect(std::abs(gpu.steps[n] - cpu.steps[n]) < 1e-3f, "where patches end");
  }
  expect(found > 300 && other <= found / 100, "which end");
  in_other_orders([&] {
    const auto again = ends_on_gpu(c, from);
    expect_same_bits("steps again", again.steps, gpu.steps);
    expect_same_bits("slopes again", again.slopes, gpu.slopes);
  });
}

Blended<float> blended_on_gpu(const ImageCase& c) {
  Memory<int32_t> rows(c.rows), ids(c.ids);
  Memory<float> colours(as<float>(c.colours)), crossings(as<float>(c.crossings)), g_image(as<float>(c.g_image));
  Memory<float> g_transmittance(as<float>(c.g_transmittance)), image(g_image.count()), transmittance(c.pixels());
  Memory<float> g_means(2 * c.count()), g_colours(colours.count()), g_crossings(crossings.count());
  const PatchImage<float> in{rows.get(), ids.get(), colours.get(), crossings.get(), c.views,
                             c.count(),  c.width,   c.height,      c.channels,      1};
  cuda::blend_patches_forward(in, {image.get(), transmittance.get()}, nullptr);
  cuda::blend_patches_backward(in, {g_image.get(), g_transmittance.get()},
                               {g_means.get(), g_colours.get(), g_crossings.get()}, nullptr);
  return {image.values(), transmittance.values(), g_means.values(), g_colours.values(), g_crossings.values()};
}

void test_blending(int channels) {
  const PatchCase patches = patch_case(9, 30, 22, 0.5);
  const ImageCase c = image_case(patches, shown_on_cpu<float>(patches), channels);
  const auto cpu = blended_on_cpu<double>(c);
  const auto gpu = blended_on_gpu(c);
  expect_close("image", gpu.image, cpu.image, 1e-5);
  expect_close("transmittance", gpu.transmittance, cpu.transmittance, 1e-5);
  expect_close("gradient by means", gpu.g_means, cpu.g_means, 1e-5);
  expect_close("gradient by colours", gpu.g_colours, cpu.g_colours, 1e-5);
  expect_close("gradient by crossings", gpu.g_crossings, cpu.g_crossings, 1e-5);
  in_other_orders([&] {
    const auto again = blended_on_gpu(c);
    expect_same_bits("image again", again.image, gpu.image);
    expect_same_bits("gradient by means again", again.g_means, gpu.g_means);
    expect_same_bits("gradient by crossings again", again.g_crossings, gpu.g_crossings);
  });
}

}  // namespace

int main() {
  skip_without_gpu();
  test_values(700, 9, 3, 0), test_values(60, 400, 1, -1), test_values(300, 5, 4, 3), test_no_samples();
  test_visible_patches(9, 40, 30, 0.5), test_visible_patches(600, 24, 20, 0.1), test_visible_patches(1, 17, 33, 2.0);
  test_outlines(), test_blending(1), test_blending(4);
  return report();
}
