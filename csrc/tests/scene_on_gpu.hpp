// A scene in the memory of a GPU (tests/GPU.hpp), and all CUDA kernels run on it, forward and backward, as tests/scene.hpp does it on
// the CPU. Workspaces have exactly the bytes that were asked for.
#pragma once

#include <limits>

#include "tests/gpu.hpp"
#include "tests/scene.hpp"

namespace check {

using cuda::Lent;

inline constexpr int64_t kNoLimit = std::numeric_limits<int32_t>::max();

// The arrays of a scene in the GPU's memory, and the structs that point into them.
struct OnGpu {
  const Scene& scene;
  const Inputs<float> in;
  bool with_cameras = true, with_probe = true, with_background = true;  // whether these are given, or asked for
  Memory<float> means, quats, scales, opacities, viewmats, intrinsics, centers, sh, background;

  explicit OnGpu(const Scene& s)
      : scene(s),
        in(s, 1),
        means(in.means, "means"),
        quats(in.quats, "quats"),
        scales(in.scales, "scales"),
        opacities(in.opacities, "opacities"),
        viewmats(in.viewmats, "viewmats"),
        intrinsics(in.intrinsics, "intrinsics"),
        centers(in.centers, "centers"),
        sh(in.sh, "sh"),
        background(in.background, "background") {}

  const float* behind() { return with_background ? background.get() : nullptr; }
  GaussianViews<float> views() {
    GaussianViews<float> v = in.views();
    v.means = means.get(), v.quats = quats.get(), v.scales = scales.get(), v.opacities = opacities.get();
    v.viewmats = viewmats.get(), v.intrinsics = intrinsics.get();
    return v;
  }
  Harmonics<float> harmonics(const int32_t* radii) {
    Harmonics<float> h = in.harmonics(radii);
    h.means = means.get(), h.centers = centers.get(), h.sh = sh.get();
    return h;
  }
};

// A workspace of exactly the bytes that were asked for.
struct Borrowed {
  Memory<char> memory;
  explicit Borrowed(int64_t bytes) : memory(bytes, "a workspace") {}
  Lent lent() { return {memory.get(), memory.count()}; }
};

// The splats of a scene in the GPU's memory.
struct GpuSplats {
  Memory<float> means2d, depths, factors, opacities, colors;
  Memory<int32_t> radii;
  explicit GpuSplats(const Drawn<float>& d)
      : means2d(d.means2d, "means2d"),
        depths(d.depths, "depths"),
        factors(d.factors, "factors"),
        opacities(d.opacities, "splat opacities"),
        colors(d.colors, "colors"),
        radii(d.radii, "radii") {}
  Splats<float> splats(const Inputs<float>& in, const Drawn<float>& d) {
    Splats<float> s = in.splats(d);
    s.means2d = means2d.get(), s.depths = depths.get(), s.factors = factors.get(), s.opacities = opacities.get();
    s.colors = colors.get(), s.radii = radii.get();
    return s;
  }
};

inline void project_on_gpu(OnGpu& gpu, Drawn<float>& d) {
  const Scene& s = gpu.scene;
  const int64_t rows = s.views * s.n;
  Memory<float> means2d(2 * rows), depths(rows), factors(3 * rows), compensations(rows), colors(3 * rows);
  Memory<int32_t> radii(2 * rows);
  cuda::project_forward(gpu.views(), gpu.in.options(),
                        {means2d.get(), depths.get(), factors.get(), compensations.get(), radii.get()}, nullptr);
  d.means2d = means2d.values(), d.depths = depths.values(), d.factors = factors.values();
  d.compensations = compensations.values(), d.radii = radii.values();
  d.opacities.resize(rows);
  for (int64_t i = 0; i < rows; ++i)
    d.opacities[i] = gpu.in.opacities[i % s.n] * (s.antialiased ? d.compensations[i] : 1.f);
  d.colors = as<float>(s.features);
  if (s.channels != 3) return;
  cuda::harmonics_forward(gpu.harmonics(radii.get()), colors.get(), nullptr);
  d.colors = colors.values();
}

inline Binning bin_on_gpu(const Splats<float>& s, int64_t max_entries = kNoLimit) {
  const int64_t rows = s.num_views * s.num_gaussians;
  const int64_t tiles = s.num_views * ((s.width + kTile - 1) / kTile) * int64_t{(s.height + kTile - 1) / kTile};
  Borrowed counted(cuda::bin_count_workspace(rows));
  const int64_t count = cuda::bin_count(s, max_entries, counted.lent(), nullptr);
  Borrowed workspace(cuda::bin_emit_workspace(count));
  Memory<int64_t> tile_offsets(tiles + 1);
  Memory<int32_t> slot_ranges(2 * rows), gaussians(count), slots(count);
  cuda::bin_emit(s, count, counted.lent(), {tile_offsets.get(), slot_ranges.get(), gaussians.get(), slots.get()},
                 workspace.lent(), nullptr);
  return {tile_offsets.values(), slot_ranges.values(), gaussians.values(), slots.values()};
}

// The lists of a Binning in the GPU's memory.
struct GpuEntries {
  Memory<int64_t> tile_offsets;
  Memory<int32_t> slot_ranges, gaussians, slots;
  explicit GpuEntries(const Binning& b)
      : tile_offsets(b.tile_offsets), slot_ranges(b.slot_ranges), gaussians(b.gaussians), slots(b.slots) {}
  Entries entries() { return {tile_offsets.get(), slot_ranges.get(), gaussians.get(), slots.get(), gaussians.count()}; }
};

inline void draw_on_gpu(OnGpu& gpu, const Splats<float>& splats, const Entries& entries, Tally tally, Drawn<float>& d) {
  const Scene& s = gpu.scene;
  Memory<float> color(s.pixels() * s.channels), transmittance(s.pixels()), sums(s.views * s.n);
  Memory<int32_t> stop(s.pixels());
  Borrowed workspace(cuda::rasterize_forward_workspace(entries.count, tally));
  cuda::rasterize_forward(
      splats, entries,
      {color.get(), transmittance.get(), stop.get(), gpu.behind(), tally == Tally::kNone ? nullptr : sums.get(), tally},
      workspace.lent(), nullptr);
  d.color = color.values(), d.transmittance = transmittance.values(), d.stop = stop.values();
  for (int k = 0; k < 4; ++k)
    if (kTallies[k] == tally) d.tallies[k] = sums.values();
}

inline void harmonics_backward_on_gpu(OnGpu& gpu, Drawn<float>& d) {
  const Scene& s = gpu.scene;
  Memory<float> colors(d.colors), grads(d.g_features), by_direction(3 * s.n), sh(gpu.in.sh.size());
  Memory<float> centers(3 * s.views);
  Memory<int32_t> radii(d.radii);
  Borrowed workspace(cuda::harmonics_backward_workspace(s.n, s.views));
  cuda::harmonics_backward(gpu.harmonics(radii.get()), colors.get(), grads.get(), by_direction.get(), sh.get(),
                           gpu.with_cameras ? centers.get() : nullptr, workspace.lent(), nullptr);
  d.g_sh = sh.values();
  if (gpu.with_cameras) d.g_centers = centers.values();
  for (size_t i = 0; i < d.g_means.size(); ++i) d.g_means[i] += by_direction.values()[i];
}

inline void backward_on_gpu(OnGpu& gpu, const Splats<float>& splats, const Entries& entries,
                            const Cotangents& cotangents, Drawn<float>& d) {
  const Scene& s = gpu.scene;
  const int64_t rows = s.views * s.n;
  Memory<float> g_color(as<float>(cotangents.color)), g_transmittance(as<float>(cotangents.transmittance));
  Memory<float> final_transmittance(d.transmittance), g_means2d(2 * rows), g_factors(3 * rows), g_seen(rows);
  Memory<float> g_colors(rows * s.channels), probe(4 * rows);
  Memory<int32_t> stop(d.stop);
  Borrowed workspace(cuda::rasterize_backward_workspace(entries.count, s.channels, gpu.with_probe));
  cuda::rasterize_backward(splats, entries,
                           {g_color.get(), g_transmittance.get(), final_transmittance.get(), stop.get(), gpu.behind()},
                           {g_means2d.get(), g_factors.get(), g_seen.get(), g_colors.get(),
                            gpu.with_probe ? probe.get() : nullptr, gpu.with_probe},
                           workspace.lent(), nullptr);
  if (gpu.with_probe) d.probe = probe.values();
  d.g_features = g_colors.values(), d.g_opacities.assign(s.n, 0.f);
  std::vector<float> by_compensation(rows);
  const std::vector<float> seen = g_seen.values();
  for (int64_t i = 0; i < rows; ++i) {
    d.g_opacities[i % s.n] += seen[i] * (s.antialiased ? d.compensations[i] : 1.f);
    by_compensation[i] = s.antialiased ? seen[i] * gpu.in.opacities[i % s.n] : 0.f;
  }
  Memory<float> g_compensations(by_compensation), g_depths(as<float>(cotangents.depths));
  Memory<float> means(3 * s.n), quats(4 * s.n), scales(3 * s.n), viewmats(16 * s.views), intrinsics(9 * s.views);
  Memory<int32_t> radii(d.radii);
  Borrowed partials(cuda::project_backward_workspace(s.n, s.views));
  cuda::project_backward(gpu.views(), gpu.in.options(), radii.get(),
                         {g_means2d.get(), g_depths.get(), g_factors.get(), g_compensations.get()},
                         {means.get(), quats.get(), scales.get(), gpu.with_cameras ? viewmats.get() : nullptr,
                          gpu.with_cameras ? intrinsics.get() : nullptr},
                         partials.lent(), nullptr);
  d.g_means = means.values(), d.g_quats = quats.values(), d.g_scales = scales.values();
  if (gpu.with_cameras) d.g_viewmats = viewmats.values(), d.g_intrinsics = intrinsics.values();
  if (s.channels == 3) harmonics_backward_on_gpu(gpu, d);
}

// Everything that `draw` computes on the CPU.
inline Drawn<float> draw_on_gpu(OnGpu& gpu, const Cotangents* cotangents) {
  Drawn<float> d;
  project_on_gpu(gpu, d);
  GpuSplats held(d);
  const Splats<float> splats = held.splats(gpu.in, d);
  GpuEntries lists(bin_on_gpu(splats));
  draw_on_gpu(gpu, splats, lists.entries(), Tally::kNone, d);
  if (cotangents == nullptr) return d;
  backward_on_gpu(gpu, splats, lists.entries(), *cotangents, d);
  for (const Tally tally : kTallies) draw_on_gpu(gpu, splats, lists.entries(), tally, d);
  return d;
}

inline Drawn<float> draw_on_gpu(const Scene& s, const Cotangents* cotangents) {
  OnGpu gpu(s);
  return draw_on_gpu(gpu, cotangents);
}

}  // namespace check
