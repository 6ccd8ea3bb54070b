// The patch that each pixel shows: a z-buffer of the flat faces of patches. Bands of rows are tasks; each goes through its
// patches in their order, so that ties are the first's on any number of threads.
#include <algorithm>
#include <cmath>
#include <vector>

#include "core/triangles.hpp"
#include "cpu/parallel.hpp"
#include "math/projection.hpp"

namespace dyngs {
namespace {

constexpr int kBand = 16;             // rows
constexpr int64_t kPatchGrain = 128;  // patches

struct Box {
  int x0 = 0, y0 = 0, x1 = 0, y1 = 0;  // pixels from x0 to before x1

  bool empty() const { return x0 >= x1 || y0 >= y1; }
};

// The pixels whose centres may lie within points of the image.
class Bounds {
 public:
  void add(const Pinhole<double>& cam, const Vec3<double>& p) {
    const double x = cam.fx * p.x / p.z + cam.cx, y = cam.fy * p.y / p.z + cam.cy;
    x0_ = std::min(x0_, x), x1_ = std::max(x1_, x), y0_ = std::min(y0_, y), y1_ = std::max(y1_, y);
  }
  Box box(const Pinhole<double>& cam) const {
    return {low(x0_, cam.width), low(y0_, cam.height), high(x1_, cam.width), high(y1_, cam.height)};
  }

 private:
  static int low(double x, double size) { return static_cast<int>(std::clamp(std::ceil(x - 0.5), 0.0, size)); }
  static int high(double x, double size) { return static_cast<int>(std::clamp(std::floor(x - 0.5) + 1, 0.0, size)); }

  double x0_ = HUGE_VAL, x1_ = -HUGE_VAL, y0_ = HUGE_VAL, y1_ = -HUGE_VAL;
};

// Of the part of a triangle that is not nearer than `near`.
Box box_of(const Pinhole<double>& cam, double near, const Vec3<double> (&corners)[3]) {
  Bounds bounds;
  for (int i = 0; i < 3; ++i) {
    const Vec3<double>&a = corners[i], &b = corners[(i + 1) % 3];
    if (a.z >= near) bounds.add(cam, a);
    if ((a.z >= near) != (b.z >= near)) {
      Vec3<double> cut = a + (b - a) * ((near - a.z) / (b.z - a.z));
      cut.z = near;
      bounds.add(cam, cut);
    }
  }
  return bounds.box(cam);
}

// The patches of a view as lattices of points in the camera.
template <class S>
class Lattices {
 public:
  Lattices(const PatchViews<S>& in, const Pinhole<double>& cam)
      : in_(in), cam_(cam), size_(lattice_size(in.segments)), points_(in.patches * size_ * 3), bands_(in.patches) {
    parallel_for(in.patches, kPatchGrain, in.threads, [&](int64_t begin, int64_t end) {
      for (int64_t p = begin; p < end; ++p) place(p);
    });
  }

  // The bands of rows that a patch may be seen in: from the first to before the second.
  std::pair<int, int> bands(int64_t patch) const { return bands_[patch]; }

  // f(corners, i, j, is_upper) of each face; (i, j) of the corner that it is described by.
  template <class F>
  void for_each_face(int64_t patch, F&& f) const {
    const int n = in_.segments;
    for (int i = 0; i < n; ++i) {
      for (int j = 0; i + j < n; ++j) {
        f({point(patch, i, j), point(patch, i + 1, j), point(patch, i, j + 1)}, i, j, false);
        if (i + j + 2 <= n) f({point(patch, i + 1, j + 1), point(patch, i, j + 1), point(patch, i + 1, j)}, i, j, true);
      }
    }
  }

 private:
  Vec3<double> point(int64_t patch, int i, int j) const {
    const S* p = points_.data() + 3 * (patch * size_ + lattice_index(in_.segments, i, j));
    return {static_cast<double>(p[0]), static_cast<double>(p[1]), static_cast<double>(p[2])};
  }

  void place(int64_t patch) {
    const S* control = in_.points + patch * kPatchPoints * 3;
    bands_[patch] = {0, 0};
    for (int i = 0; i < 3 * kPatchPoints; ++i) {
      if (!std::isfinite(control[i])) return;
    }
    const int n = in_.segments;
    for (int i = 0; i <= n; ++i) {
      for (int j = 0; i + j <= n; ++j) {
        const auto at = quadratic_weights(static_cast<double>(i) / n, static_cast<double>(j) / n);
        Vec3<double> world{0, 0, 0};
        for (int k = 0; k < kPatchPoints; ++k) {
          const S* p = control + 3 * k;
          world = world + Vec3<double>{double(p[0]), double(p[1]), double(p[2])} * at.weight[k];
        }
        const Vec3<double> p = to_camera(cam_, world);
        S* to = points_.data() + 3 * (patch * size_ + lattice_index(n, i, j));
        to[0] = static_cast<S>(p.x), to[1] = static_cast<S>(p.y), to[2] = static_cast<S>(p.z);
      }
    }
    int first = in_.height, last = 0;
    for_each_face(patch, [&](const Vec3<double>(&corners)[3], int, int, bool) {
      const Box box = box_of(cam_, in_.near, corners);
      if (!box.empty()) first = std::min(first, box.y0), last = std::max(last, box.y1);
    });
    if (first < last) bands_[patch] = {first / kBand, (last - 1) / kBand + 1};
  }

  const PatchViews<S>& in_;
  const Pinhole<double>& cam_;
  int64_t size_;
  std::vector<S> points_;
  std::vector<std::pair<int, int>> bands_;
};

template <class S>
void draw_band(const PatchViews<S>& in, const Pinhole<double>& cam, const Lattices<S>& lattices,
               const std::vector<int32_t>& patches, int y0, int32_t* ids, S* uv) {
  const int y1 = std::min(y0 + kBand, in.height);
  std::vector<double> nearest(static_cast<size_t>(y1 - y0) * in.width, HUGE_VAL);
  std::fill(ids + int64_t{y0} * in.width, ids + int64_t{y1} * in.width, -1);
  std::fill(uv + 2 * int64_t{y0} * in.width, uv + 2 * int64_t{y1} * in.width, S(0));
  for (const int32_t patch : patches) {
    lattices.for_each_face(patch, [&](const Vec3<double>(&corners)[3], int i, int j, bool upper) {
      Box box = box_of(cam, in.near, corners);
      box.y0 = std::max(box.y0, y0), box.y1 = std::min(box.y1, y1);
      if (box.empty()) return;
      const RayTriangle triangle = ray_triangle(corners[0], corners[1], corners[2]);
      if (!triangle.is_drawn()) return;
      for (int y = box.y0; y < box.y1; ++y) {
        const double ray_y = (y + 0.5 - cam.cy) / cam.fy;
        for (int x = box.x0; x < box.x1; ++x) {
          double bary[3];
          const double z = hit(triangle, (x + 0.5 - cam.cx) / cam.fx, ray_y, bary);
          double& best = nearest[static_cast<size_t>(y - y0) * in.width + x];
          if (!(z >= in.near && z < best)) continue;
          best = z;
          const int64_t pixel = int64_t{y} * in.width + x;
          ids[pixel] = patch;
          uv[2 * pixel] = static_cast<S>((upper ? i + 1 - bary[1] : i + bary[1]) / in.segments);
          uv[2 * pixel + 1] = static_cast<S>((upper ? j + 1 - bary[2] : j + bary[2]) / in.segments);
        }
      }
    });
  }
}

}  // namespace

template <class S>
void visible_patches(const PatchViews<S>& in, const VisiblePatches<S>& out) {
  const int64_t pixels = int64_t{in.width} * in.height;
  const int count = (in.height + kBand - 1) / kBand;
  for (int64_t view = 0; view < in.views; ++view) {
    double pose[16], inner[9];
    std::copy_n(in.viewmats + 16 * view, 16, pose);
    std::copy_n(in.intrinsics + 9 * view, 9, inner);
    const Pinhole<double> cam = pinhole(pose, inner, in.width, in.height);
    const Lattices<S> lattices(in, cam);
    std::vector<std::vector<int32_t>> bands(count);
    for (int64_t p = 0; p < in.patches; ++p) {
      const auto [first, last] = lattices.bands(p);
      for (int b = first; b < last; ++b) bands[b].push_back(static_cast<int32_t>(p));
    }
    parallel_for(count, 1, in.threads, [&](int64_t begin, int64_t) {
      const int band = static_cast<int>(begin);
      draw_band(in, cam, lattices, bands[band], band * kBand, out.ids + view * pixels, out.uv + 2 * view * pixels);
    });
  }
}

template void visible_patches<float>(const PatchViews<float>&, const VisiblePatches<float>&);
template void visible_patches<double>(const PatchViews<double>&, const VisiblePatches<double>&);

}  // namespace dyngs
