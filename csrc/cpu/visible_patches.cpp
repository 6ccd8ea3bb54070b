// The patch that each pixel shows: a z-buffer of the flat faces of patches (math/patch_faces.hpp). Bands of rows are tasks; each
// goes through its patches in their order, so that ties are the first's on any number of threads.
#include <algorithm>
#include <vector>

#include "core/triangles.hpp"
#include "cpu/parallel.hpp"
#include "math/patch_faces.hpp"

namespace dyngs {
namespace {

constexpr int kBand = 16;             // rows
constexpr int64_t kPatchGrain = 128;  // patches

struct FaceCorners {
  Vec3<double> at[3];
};

// The patches of a view as lattices of points in the camera.
template <class S>
class Lattices {
 public:
  Lattices(const PatchViews<S>& in, const Pinhole<double>& cam)
      : in_(in),
        cam_(cam),
        size_(lattice_size(in.segments)),
        points_(in.patches * size_ * 3),
        segments_(in.patches, 1),
        bands_(in.patches) {
    parallel_for(in.patches, kPatchGrain, in.threads, [&](int64_t begin, int64_t end) {
      for (int64_t p = begin; p < end; ++p) {
        if (is_finite_patch<S>(in.points + p * kPatchPoints * 3)) place(p);
      }
    });
  }

  // The bands of rows that a patch may be seen in: from the first to before the second.
  std::pair<int, int> bands(int64_t patch) const { return bands_[patch]; }
  int segments(int64_t patch) const { return segments_[patch]; }

  FaceCorners corners(int64_t patch, const PatchFace& face) const {
    FaceCorners found;
    for (int k = 0; k < 3; ++k) {
      const S* p = points_.data() + 3 * (patch * size_ + face.corners[k]);
      found.at[k] = {static_cast<double>(p[0]), static_cast<double>(p[1]), static_cast<double>(p[2])};
    }
    return found;
  }

 private:
  void place(int64_t patch) {
    const S* control = in_.points + patch * kPatchPoints * 3;
    Vec3<double> points[kPatchPoints];
    for (int k = 0; k < kPatchPoints; ++k) {
      const S* p = control + 3 * k;
      points[k] = to_camera(cam_, Vec3<double>{double(p[0]), double(p[1]), double(p[2])});
    }
    const int n = segments_[patch] = segments_for(cam_, in_.near, in_.segments, points);
    for (int i = 0; i <= n; ++i) {
      for (int j = 0; i + j <= n; ++j) {
        const auto at = quadratic_weights(static_cast<double>(i) / n, static_cast<double>(j) / n);
        Vec3<double> p{0, 0, 0};
        for (int k = 0; k < kPatchPoints; ++k) p = p + points[k] * at.weight[k];
        S* to = points_.data() + 3 * (patch * size_ + lattice_index(n, i, j));
        to[0] = static_cast<S>(p.x), to[1] = static_cast<S>(p.y), to[2] = static_cast<S>(p.z);
      }
    }
    int first = in_.height, last = 0;
    for_each_face(n, [&](const PatchFace& face) {
      const PixelBox box = pixels_of(cam_, in_.near, corners(patch, face).at);
      if (!box.empty()) first = std::min(first, box.y0), last = std::max(last, box.y1);
    });
    if (first < last) bands_[patch] = {first / kBand, (last - 1) / kBand + 1};
  }

  const PatchViews<S>& in_;
  const Pinhole<double>& cam_;
  int64_t size_;
  std::vector<S> points_;
  std::vector<int> segments_;
  std::vector<std::pair<int, int>> bands_;
};

// A band of rows with what is nearest so far.
template <class S>
class Band {
 public:
  Band(const PatchViews<S>& in, const Pinhole<double>& cam, int y0, int32_t* ids, S* uv)
      : in_(in), cam_(cam), y0_(y0), y1_(std::min(y0 + kBand, in.height)), ids_(ids), uv_(uv) {
    const int64_t first = int64_t{y0_} * in.width, last = int64_t{y1_} * in.width;
    nearest_.assign(last - first, kEndless);
    std::fill(ids + first, ids + last, -1);
    std::fill(uv + 2 * first, uv + 2 * last, S(0));
  }

  void draw(int32_t patch, int segments, const PatchFace& face, const FaceCorners& corners) {
    PixelBox box = pixels_of(cam_, in_.near, corners.at);
    box.y0 = std::max(box.y0, y0_), box.y1 = std::min(box.y1, y1_);
    if (box.empty()) return;
    const RayTriangle triangle = ray_triangle(corners.at[0], corners.at[1], corners.at[2]);
    if (!triangle.is_drawn()) return;
    for (int y = box.y0; y < box.y1; ++y) {
      for (int x = box.x0; x < box.x1; ++x) {
        double u, v;
        const double z = hit_face(cam_, triangle, face, segments, x, y, u, v);
        double& best = nearest_[static_cast<size_t>(y - y0_) * in_.width + x];
        if (!(z >= in_.near && z < best)) continue;
        best = z;
        const int64_t pixel = int64_t{y} * in_.width + x;
        ids_[pixel] = patch;
        uv_[2 * pixel] = static_cast<S>(u), uv_[2 * pixel + 1] = static_cast<S>(v);
      }
    }
  }

 private:
  const PatchViews<S>& in_;
  const Pinhole<double>& cam_;
  int y0_, y1_;
  int32_t* ids_;
  S* uv_;
  std::vector<double> nearest_;
};

template <class S>
void draw_view(const PatchViews<S>& in, const Pinhole<double>& cam, int32_t* ids, S* uv) {
  const int count = (in.height + kBand - 1) / kBand;
  const Lattices<S> lattices(in, cam);
  std::vector<std::vector<int32_t>> of_bands(count);
  for (int64_t p = 0; p < in.patches; ++p) {
    const auto [first, last] = lattices.bands(p);
    for (int b = first; b < last; ++b) of_bands[b].push_back(static_cast<int32_t>(p));
  }
  parallel_for(count, 1, in.threads, [&](int64_t begin, int64_t) {
    Band<S> band(in, cam, static_cast<int>(begin) * kBand, ids, uv);
    for (const int32_t patch : of_bands[begin]) {
      const int n = lattices.segments(patch);
      for_each_face(n, [&](const PatchFace& face) { band.draw(patch, n, face, lattices.corners(patch, face)); });
    }
  });
}

}  // namespace

template <class S>
void visible_patches(const PatchViews<S>& in, const VisiblePatches<S>& out) {
  const int64_t pixels = int64_t{in.width} * in.height;
  for (int64_t view = 0; view < in.views; ++view) {
    double pose[16], inner[9];
    std::copy_n(in.viewmats + 16 * view, 16, pose);
    std::copy_n(in.intrinsics + 9 * view, 9, inner);
    const Pinhole<double> cam = pinhole(pose, inner, in.width, in.height);
    draw_view(in, cam, out.ids + view * pixels, out.uv + 2 * view * pixels);
  }
}

template void visible_patches<float>(const PatchViews<float>&, const VisiblePatches<float>&);
template void visible_patches<double>(const PatchViews<double>&, const VisiblePatches<double>&);

}  // namespace dyngs
