// The kernels of curved triangles, as a program without Python: against plain formulas in double, their gradients against central
// differences, float against double, several threads against one; degenerate patches.
#include <algorithm>
#include <limits>

#include "math/patch_faces.hpp"
#include "tests/triangles.hpp"

namespace {

using namespace dyngs;
using namespace check;

constexpr double kNone = std::numeric_limits<double>::quiet_NaN();

void test_values(int basis, int64_t channels) {
  const ValueCase c = value_case(400, 7, channels, basis);
  const std::string what = ", basis " + std::to_string(basis);
  const auto d = values_on_cpu<double>(c);
  const auto total = [&](const Values& values) {
    ValueCase other = c;
    other.values = values;
    return dot(c.g_out, values_on_cpu<double>(other).out);
  };
  expect_gradient("slopes" + what, total, c.values, d.g_values, 1e-2, 1e-10, 60);
  const auto f = values_on_cpu<float>(c);
  expect_close("float values" + what, f.out, d.out, 1e-5);
  expect_close("float gradient" + what, f.g_values, d.g_values, 1e-5);
  for (const int threads : {2, 5}) {
    const auto other = values_on_cpu<float>(c, threads);
    expect_same_bits("values on threads" + what, other.out, f.out);
    expect_same_bits("gradient on threads" + what, other.g_values, f.g_values);
  }
}

// Every place that is shown is on its pixel's ray, on the smooth patch to kFlat px where segments are enough.
void test_visible_points() {
  PatchCase c = patch_case(9, 60, 44, 0.5);
  c.segments = 16;
  const auto shown = shown_on_cpu<double>(c);
  int64_t drawn = 0;
  for (int64_t i = 0; i < c.pixels(); ++i) {
    if (shown.ids[i] < 0) continue;
    const int64_t view = i / (c.pixels() / c.views()), x = i % c.width, y = i / c.width % c.height;
    const Pinhole<double> cam = pinhole(&c.viewmats[16 * view], &c.intrinsics[9 * view], c.width, c.height);
    const auto jet = patch_jet(cam, &c.points[18 * int64_t{shown.ids[i]}], shown.uv[2 * i], shown.uv[2 * i + 1]);
    const double off = std::hypot(jet.at.x - static_cast<double>(x) - 0.5, jet.at.y - static_cast<double>(y) - 0.5);
    expect(off < 2 * kFlat, "a place is where its pixel is");
    ++drawn;
  }
  expect(drawn > 300, std::to_string(drawn) + " pixels show a patch");
  for (const int threads : {2, 5}) {
    const auto other = shown_on_cpu<double>(c, threads);
    expect(other.ids == shown.ids, "what is shown on threads");
    expect_same_bits("places on threads", other.uv, shown.uv);
  }
}

void test_degenerate_patches() {
  PatchCase c = patch_case(6, 20, 16, 0.5);
  const auto set = [&](int64_t patch, const Values& points) {
    for (int i = 0; i < 18; ++i) c.points[18 * patch + i] = points[i % points.size()];
  };
  set(0, {0.25, 0.5, 0.125});                                      // one point
  set(1, {0, 0, 0, 1, 0, 0, 2, 0, 0, 2, 0, 0, 3, 0, 0, 4, 0, 0});  // a line
  set(2, {0, 0, 90, 1, 0, 90, 0, 1, 91}),
      set(3, {0, 0, -90, 1, 0, -90, 0, 1, -91});  // behind one camera each, far away
  c.points[18 * 4 + 5] = kNone, c.points[18 * 5 + 11] = std::numeric_limits<double>::infinity();
  const auto shown = shown_on_cpu<float>(c);
  for (const int32_t id : shown.ids) expect(id == -1 || id == 2 || id == 3, "what is no triangle is not shown");
  c.points.clear();
  for (const int32_t id : shown_on_cpu<float>(c).ids) expect(id == -1, "nothing is shown of no patches");
}

// A flat patch with an upright edge at a known column.
void test_known_outline() {
  for (const double edge : {10.125, 10.5, 10.9375}) {
    PatchCase c = patch_case(1, 20, 16, 0.5);
    c.viewmats[3] = 0, c.viewmats.resize(16), c.intrinsics.resize(9);
    const double right = (edge - 10) * 3 / 25;
    c.points = {right, -9, 0, right, 0, 0, right / 2 - 4.5, -4.5, 0, right, 9, 0, right / 2 - 4.5, 4.5, 0, -9, 0, 0};
    const auto shown = shown_on_cpu<float>(c);
    const auto steps = step_case(c, shown);
    const auto ends = ends_on_cpu<double>(c, steps);
    const int column = edge < 10.5 ? 9 : edge > 10.5 ? 10 : shown.ids[8 * 20 + 10] == 0 ? 10 : 9;
    const int64_t at = 4 * (8 * 20 + column);  // to the right
    expect(ends.found[at] == 1 && ends.found[at - 8] == 0, "it ends in the pixel that its edge is in");
    expect_near("where it ends", ends.steps[at], edge - column - 0.5, 1e-5);
    expect_near("slope across", ends.slopes[2 * at], 1, 1e-5);
    expect_near("slope along", ends.slopes[2 * at + 1], 0, 1e-5);
  }
}

void test_outlines() {
  const PatchCase c = patch_case(9, 60, 44, 0.5);
  const auto steps = step_case(c, shown_on_cpu<float>(c));
  const auto d = ends_on_cpu<double>(c, steps);
  int64_t found = 0;
  for (int64_t n = 0; n < steps.count(); ++n) {
    if (d.found[n] == 0) {
      expect(d.steps[n] == 0 && d.slopes[2 * n] == 0, "what is not found is 0");
      continue;
    }
    ++found;
    const double u = d.uv[2 * n], v = d.uv[2 * n + 1];
    expect(std::min({std::abs(u), std::abs(v), std::abs(1 - u - v)}) < 1e-9, "a patch ends on an edge");
    expect(d.steps[n] >= 0 && d.steps[n] <= 1, "within a step");
  }
  expect(found > 500, "many end");
  for (const int threads : {2, 5}) {
    const auto other = ends_on_cpu<double>(c, steps, threads);
    expect(other.found == d.found, "ends on threads");
    expect_same_bits("steps on threads", other.steps, d.steps);
    expect_same_bits("slopes on threads", other.slopes, d.slopes);
  }
}

void test_blending(int channels) {
  const PatchCase patches = patch_case(9, 30, 22, 0.5);
  ImageCase c = image_case(patches, shown_on_cpu<float>(patches), channels);
  const auto d = blended_on_cpu<double>(c);
  const auto total = [&](const ImageCase& other) {
    const auto drawn = blended_on_cpu<double>(other);
    return dot(c.g_image, drawn.image) + dot(c.g_transmittance, drawn.transmittance);
  };
  const auto with_colours = [&](const Values& x) {
    ImageCase other = c;
    other.colours = x;
    return total(other);
  };
  const auto with_crossings = [&](const Values& x) {
    ImageCase other = c;
    other.crossings = x;
    return total(other);
  };
  expect_gradient("slopes by colours", with_colours, c.colours, d.g_colours, 1e-3, 1e-8, 60);
  expect_gradient("slopes by crossings", with_crossings, c.crossings, d.g_crossings, 1e-6, 1e-6, 60);
  const auto f = blended_on_cpu<float>(c);
  expect_close("float image", f.image, d.image, 1e-6);
  expect_close("float gradient by means", f.g_means, d.g_means, 1e-5);
  expect_close("float gradient by colours", f.g_colours, d.g_colours, 1e-5);
  expect_close("float gradient by crossings", f.g_crossings, d.g_crossings, 1e-5);
  for (const int threads : {2, 5}) {
    const auto other = blended_on_cpu<float>(c, threads);
    expect_same_bits("image on threads", other.image, f.image);
    expect_same_bits("gradient by means on threads", other.g_means, f.g_means);
    expect_same_bits("gradient by crossings on threads", other.g_crossings, f.g_crossings);
  }
}

// Colours that rise along x: moving what is shown by a pixel lowers each by the rise.
void test_moving_colours() {
  const PatchCase patches = patch_case(3, 60, 44, 0.9);
  ImageCase c = image_case(patches, shown_on_cpu<float>(patches), 1);
  std::fill(c.crossings.begin(), c.crossings.end(), 0.5), std::fill(c.g_image.begin(), c.g_image.end(), 1.0);
  for (int64_t i = 0; i < c.pixels(); ++i)
    if (c.rows[i] >= 0) c.colours[c.rows[i]] = 0.25 * static_cast<double>(i % c.width);
  const auto d = blended_on_cpu<double>(c);
  int64_t inner = 0;
  for (int64_t n = 0; n < c.count(); ++n) {
    expect(d.g_means[2 * n] == 0 || std::abs(d.g_means[2 * n] + 0.25) < 1e-12, "as far as colours rise, or alone");
    inner += d.g_means[2 * n] != 0 ? 1 : 0;
    expect(std::abs(d.g_means[2 * n + 1]) < 1e-12, "not along y");
  }
  expect(inner > 50, std::to_string(inner) + " have neighbours");
}

// One splat per covered pixel, blended with weights near outlines.
struct BoundedCase {
  int width, height;
  int64_t n;
  std::vector<int32_t> rows, ids, radii;
  Values means, factors, opacities, depths, colors, samples, g_color, g_transmittance;
};

BoundedCase bounded_case(int width, int height) {
  BoundedCase c{width, height, 0, {}, {}, {}, {}, {}, {}, {}, {}, {}, {}, {}};
  for (int i = 0; i < width * height; ++i) {
    const double x = i % width + 0.5, y = i / width + 0.5;
    const int patch = static_cast<int>(x / 7 + y / 9) % 4 - 1;
    c.rows.push_back(patch < 0 ? -1 : static_cast<int32_t>(c.n++));
    if (patch < 0) continue;
    c.ids.push_back(patch);
    for (const double at : {x, y}) {
      c.means.push_back(at + uniform(-0.3, 0.3));
      c.samples.push_back(at + uniform(0.15, 0.45));
    }
  }
  c.radii.assign(2 * c.n, 9);
  for (int64_t i = 0; i < c.n; ++i)
    for (const double factor : {0.6, 0.1, 0.8}) c.factors.push_back(factor * uniform(0.8, 1.2));
  c.opacities = uniforms(c.n, 0.2, 0.7), c.depths = uniforms(c.n, 1, 2), c.colors = uniforms(3 * c.n, 0, 1);
  c.g_color = uniforms(int64_t{3} * width * height, -1, 1);
  c.g_transmittance = uniforms(int64_t{width} * height, -1, 1);
  return c;
}

template <class S>
struct Bounded {
  std::vector<S> color, transmittance, g_means, g_factors, g_opacities, g_colors, g_samples;
};

template <class S>
Bounded<S> bounded_on_cpu(const BoundedCase& c, int threads = 1) {
  const auto means = as<S>(c.means), factors = as<S>(c.factors), opacities = as<S>(c.opacities);
  const auto depths = as<S>(c.depths), colors = as<S>(c.colors), samples = as<S>(c.samples);
  const auto g_color = as<S>(c.g_color), g_transmittance = as<S>(c.g_transmittance);
  const Splats<S> splats{c.n,
                         1,
                         c.width,
                         c.height,
                         3,
                         means.data(),
                         factors.data(),
                         opacities.data(),
                         depths.data(),
                         colors.data(),
                         c.radii.data(),
                         S(0),
                         S(0.99),
                         S(0),
                         threads};
  const Boundaries<S> boundaries{c.rows.data(), c.ids.data(), samples.data(), S(2)};
  const Binning bins = bin_tiles(splats, std::numeric_limits<int32_t>::max());
  const Entries entries{bins.tile_offsets.data(), bins.slot_ranges.data(), bins.gaussians.data(), bins.slots.data(),
                        static_cast<int64_t>(bins.gaussians.size())};
  const int64_t pixels = int64_t{c.width} * c.height;
  std::vector<int32_t> stop(pixels);
  Bounded<S> out;
  out.color.resize(3 * pixels), out.transmittance.resize(pixels);
  rasterize_bounded_forward(
      splats, entries, boundaries,
      Image<S>{out.color.data(), out.transmittance.data(), stop.data(), nullptr, nullptr, Tally::kNone});
  out.g_means.resize(2 * c.n), out.g_factors.resize(3 * c.n), out.g_opacities.resize(c.n);
  out.g_colors.resize(3 * c.n), out.g_samples.resize(2 * c.n);
  rasterize_bounded_backward(
      splats, entries, boundaries,
      ImageGrads<S>{g_color.data(), g_transmittance.data(), out.transmittance.data(), stop.data(), nullptr},
      SplatGrads<S>{out.g_means.data(), out.g_factors.data(), out.g_opacities.data(), out.g_colors.data(), nullptr,
                    false},
      out.g_samples.data());
  return out;
}

void test_bounded() {
  const BoundedCase c = bounded_case(35, 27);
  const Bounded<double> d = bounded_on_cpu<double>(c);
  const auto total = [&](Values BoundedCase::* member) {
    return [&c, member](const Values& x) {
      BoundedCase moved = c;
      moved.*member = x;
      const Bounded<double> drawn = bounded_on_cpu<double>(moved);
      return dot(drawn.color, c.g_color) + dot(drawn.transmittance, c.g_transmittance);
    };
  };
  expect_gradient("slopes of samples", total(&BoundedCase::samples), c.samples, d.g_samples, 1e-6, 1e-6, 60);
  expect_gradient("slopes of bounded means", total(&BoundedCase::means), c.means, d.g_means, 1e-6, 1e-6, 20);
  expect_gradient("slopes of bounded opacities", total(&BoundedCase::opacities), c.opacities, d.g_opacities, 1e-6, 1e-6,
                  20);
  const Bounded<float> f = bounded_on_cpu<float>(c);
  expect_close("float bounded image", f.color, d.color, 1e-5);
  expect_close("float slopes of samples", f.g_samples, d.g_samples, 1e-3);
  for (const int threads : {2, 5}) {
    const Bounded<float> other = bounded_on_cpu<float>(c, threads);
    expect_same_bits("bounded image on threads", other.color, f.color);
    expect_same_bits("slopes of samples on threads", other.g_samples, f.g_samples);
    expect_same_bits("slopes of bounded means on threads", other.g_means, f.g_means);
  }
}

}  // namespace

int main() {
  skip_unless_supported();
  for (const int basis : {0, -1, -2, 1, 3}) test_values(basis, 3);
  test_values(0, 1), test_visible_points(), test_degenerate_patches(), test_known_outline(), test_outlines();
  test_blending(1), test_blending(4), test_moving_colours();
  test_bounded();
  return report();
}
