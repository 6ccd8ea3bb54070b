// Inputs of the tests of curved triangles, in float64, and the CPU kernels' results in either precision.
#pragma once

#include <cmath>
#include <cstdint>
#include <memory>
#include <vector>

#include "core/triangles.hpp"
#include "tests/check.hpp"

namespace check {

using namespace dyngs;

// Bent patches around the origin, seen from two sides.
struct PatchCase {
  Values points;  // (P, 6, 3)
  Values viewmats, intrinsics;
  int width, height, segments;
  double near;

  int64_t patches() const { return static_cast<int64_t>(points.size()) / 18; }
  int64_t views() const { return static_cast<int64_t>(intrinsics.size()) / 9; }
  int64_t pixels() const { return views() * width * height; }
};

inline PatchCase patch_case(int64_t patches, int width, int height, double size) {
  PatchCase c{uniforms(18 * patches, -size, size), {}, {}, width, height, 4, 0.5};
  for (int64_t p = 0; p < patches; ++p) {
    const Values middle = uniforms(3, -0.8, 0.8);
    for (int64_t i = 0; i < 18; ++i) c.points[18 * p + i] += middle[i % 3];
  }
  c.points = as<double>(as<float>(c.points));
  const double f = 1.25 * width;
  for (const double sign : {1.0, -1.0}) {
    const Values view{sign, 0, 0, 0.125, 0, 1, 0, 0, 0, 0, sign, 3, 0, 0, 0, 1},
        inner{f, 0, width / 2.0, 0, f, height / 2.0, 0, 0, 1};
    c.viewmats.insert(c.viewmats.end(), view.begin(), view.end());
    c.intrinsics.insert(c.intrinsics.end(), inner.begin(), inner.end());
  }
  return c;
}

template <class S>
struct Shown {
  std::vector<int32_t> ids;
  std::vector<S> uv;
};

template <class S>
Shown<S> shown_on_cpu(const PatchCase& c, int threads = 1) {
  const auto points = as<S>(c.points), viewmats = as<S>(c.viewmats), intrinsics = as<S>(c.intrinsics);
  Shown<S> found{std::vector<int32_t>(c.pixels(), 7), std::vector<S>(2 * c.pixels(), S(7))};
  visible_patches<S>({points.data(), viewmats.data(), intrinsics.data(), c.patches(), c.views(), c.width, c.height,
                      c.segments, static_cast<S>(c.near), threads},
                     {found.ids.data(), found.uv.data()});
  return found;
}

// From every pixel of what is shown one step in each direction.
struct StepCase {
  std::vector<int32_t> views, ids, directions;
  Values uv;

  int64_t count() const { return static_cast<int64_t>(ids.size()); }
};

inline StepCase step_case(const PatchCase& c, const Shown<float>& shown) {
  StepCase steps;
  for (int64_t i = 0; i < c.pixels(); ++i) {
    for (int32_t d = 0; d < kDirections; ++d) {
      steps.views.push_back(static_cast<int32_t>(i / (c.pixels() / c.views())));
      steps.ids.push_back(shown.ids[i]), steps.directions.push_back(d);
      for (int k = 0; k < 2; ++k) steps.uv.push_back(static_cast<double>(shown.uv[2 * i + k]));
    }
  }
  return steps;
}

template <class S>
struct Ends {
  std::vector<char> found;
  std::vector<S> steps, uv, slopes;
};

template <class S>
Ends<S> ends_on_cpu(const PatchCase& c, const StepCase& from, int threads = 1) {
  const auto points = as<S>(c.points), viewmats = as<S>(c.viewmats), intrinsics = as<S>(c.intrinsics);
  const auto uv = as<S>(from.uv);
  const int64_t n = from.count();
  const auto found = std::make_unique<bool[]>(n);
  Ends<S> ends{{}, std::vector<S>(n, S(7)), std::vector<S>(2 * n, S(7)), std::vector<S>(2 * n, S(7))};
  patch_ends<S>({points.data(), viewmats.data(), intrinsics.data(), from.views.data(), from.ids.data(),
                 from.directions.data(), uv.data(), n, threads},
                {found.get(), ends.steps.data(), ends.uv.data(), ends.slopes.data()});
  ends.found.assign(found.get(), found.get() + n);
  return ends;
}

// Values at places.
struct ValueCase {
  std::vector<int32_t> ids;
  Values uv, values, g_out;
  int64_t patches, size, channels;
  int basis;  // of patch_weights; positive: segments

  PatchPlaces places(int threads) const {
    const auto kind = basis > 0 ? PatchBasis::kLattice : static_cast<PatchBasis>(basis);
    return {ids.data(), static_cast<int64_t>(ids.size()), patches, size, channels, kind, basis, threads};
  }
};

inline ValueCase value_case(int64_t count, int64_t patches, int64_t channels, int basis) {
  const int64_t size = basis > 0 ? lattice_size(basis) : kPatchPoints;
  ValueCase c{{},
              uniforms(2 * count, 0, 0.5),
              uniforms(patches * size * channels, -1, 1),
              uniforms(count * channels, -1, 1),
              patches,
              size,
              channels,
              basis};
  for (int64_t n = 0; n < count; ++n) c.ids.push_back(static_cast<int32_t>(n * n % patches));
  return c;
}

template <class S>
struct ValueResults {
  std::vector<S> out, g_values;
};

template <class S>
ValueResults<S> values_on_cpu(const ValueCase& c, int threads = 1) {
  const auto uv = as<S>(c.uv), values = as<S>(c.values), g_out = as<S>(c.g_out);
  ValueResults<S> found{std::vector<S>(g_out.size(), S(7)), std::vector<S>(values.size(), S(7))};
  patch_values_forward<S>(c.places(threads), uv.data(), values.data(), found.out.data());
  patch_values_backward<S>(c.places(threads), uv.data(), g_out.data(), found.g_values.data());
  return found;
}

// Arguments of blending, with random colours and crossings.
struct ImageCase {
  std::vector<int32_t> rows, ids;
  Values colours, crossings, g_image, g_transmittance;
  int64_t views;
  int width, height, channels;

  int64_t pixels() const { return static_cast<int64_t>(rows.size()); }
  int64_t count() const { return static_cast<int64_t>(ids.size()); }
};

inline ImageCase image_case(const PatchCase& c, const Shown<float>& shown, int channels) {
  ImageCase image{{}, {}, {}, {}, {}, {}, c.views(), c.width, c.height, channels};
  for (const int32_t id : shown.ids) {
    image.rows.push_back(id < 0 ? -1 : static_cast<int32_t>(image.ids.size()));
    if (id >= 0) image.ids.push_back(id);
  }
  image.colours = uniforms(image.count() * channels, 0, 1), image.crossings = uniforms(2 * c.pixels(), 0, 1);
  image.g_image = uniforms(c.pixels() * channels, -1, 1), image.g_transmittance = uniforms(c.pixels(), -1, 1);
  return image;
}

template <class S>
struct Blended {
  std::vector<S> image, transmittance, g_means, g_colours, g_crossings;
};

template <class S>
Blended<S> blended_on_cpu(const ImageCase& c, int threads = 1) {
  const auto colours = as<S>(c.colours), crossings = as<S>(c.crossings), g_image = as<S>(c.g_image);
  const auto g_transmittance = as<S>(c.g_transmittance);
  const auto fill = [](size_t n) { return std::vector<S>(n, S(7)); };
  Blended<S> found{fill(c.g_image.size()), fill(c.rows.size()), fill(2 * c.ids.size()), fill(c.colours.size()),
                   fill(c.crossings.size())};
  const PatchImage<S> in{c.rows.data(), c.ids.data(), colours.data(), crossings.data(), c.views,
                         c.count(),     c.width,      c.height,       c.channels,       threads};
  blend_patches_forward<S>(in, {found.image.data(), found.transmittance.data()});
  blend_patches_backward<S>(in, {g_image.data(), g_transmittance.data()},
                            {found.g_means.data(), found.g_colours.data(), found.g_crossings.data()});
  return found;
}

}  // namespace check
