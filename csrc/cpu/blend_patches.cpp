// Pixels as weighted means of themselves and their neighbours, and the vjp (math/patch_blend.hpp). Bands of rows are tasks
// that gather, so that results have the same bytes on any number of threads.
#include "core/triangles.hpp"
#include "cpu/parallel.hpp"
#include "math/patch_blend.hpp"

namespace dyngs {
namespace {

constexpr int kBand = 16;  // rows

// f(star of each pixel) of all views.
template <class S, class F>
void for_each_star(const PatchImage<S>& in, F&& f) {
  const int64_t height = in.height;
  parallel_for(in.views * height, kBand, in.threads, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      for (int x = 0; x < in.width; ++x)
        f(PixelStar<S, PatchImage<S>>(in, row / height, x, static_cast<int>(row % height)));
    }
  });
}

template <class S>
struct ImageGrad {
  const S *image, *transmittance;
  int channels;

  S operator()(int64_t pixel, int c) const {
    return c == channels ? transmittance[pixel] : image[pixel * channels + c];
  }
};

// Not inlined: two copies, for one thread and for several, could round differently.
template <class S>
[[gnu::noinline]] void blend_pixel(const PatchImage<S>& in, const PixelStar<S, PatchImage<S>>& star,
                                   const BlendedPatches<S>& out) {
  for (int c = 0; c < in.channels; ++c) out.image[star.pixel() * in.channels + c] = star.blended(c);
  out.transmittance[star.pixel()] = star.blended(in.channels);
}

template <class S>
[[gnu::noinline]] void blend_pixel_vjp(const PatchImage<S>& in, const ImageGrad<S>& g,
                                       const PixelStar<S, PatchImage<S>>& star, const PatchGrads<S>& out) {
  S by_mean[2] = {};
  for (int c = 0; star.row() >= 0 && c < in.channels; ++c) {
    const S by_colour = gathered(star, g, c);
    out.colours[star.row() * in.channels + c] = by_colour;
    for (int axis = 0; axis < 2; ++axis) by_mean[axis] -= by_colour * star.slope(axis, c);
  }
  for (int axis = 0; axis < 2; ++axis) {
    if (star.row() >= 0) out.means[2 * star.row() + axis] = by_mean[axis];
    out.crossings[star.crossing(2 * axis)] = star.has(2 * axis) ? crossing_grad(star, g, 2 * axis) : S(0);
  }
}

}  // namespace

template <class S>
void blend_patches_forward(const PatchImage<S>& in, const BlendedPatches<S>& out) {
  for_each_star(in, [&](const auto& star) { blend_pixel(in, star, out); });
}

template <class S>
void blend_patches_backward(const PatchImage<S>& in, const BlendedPatches<const S>& grads, const PatchGrads<S>& out) {
  const ImageGrad<S> g{grads.image, grads.transmittance, in.channels};
  for_each_star(in, [&](const auto& star) { blend_pixel_vjp(in, g, star, out); });
}

#define DYNGS_INSTANTIATE(S)                                                              \
  template void blend_patches_forward<S>(const PatchImage<S>&, const BlendedPatches<S>&); \
  template void blend_patches_backward<S>(const PatchImage<S>&, const BlendedPatches<const S>&, const PatchGrads<S>&);
DYNGS_INSTANTIATE(float)
DYNGS_INSTANTIATE(double)
#undef DYNGS_INSTANTIATE

}  // namespace dyngs
