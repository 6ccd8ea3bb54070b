// The patch that each pixel shows (math/patch_faces.hpp). One thread per patch places its lattice in the camera and finds its
// pixels; a block of threads draws a tile: it reads the boxes of all patches, a thread each, keeps those that meet the tile, in
// their order, and each thread tries their faces on its pixel. A tie is the first patch's, without atomics.
//
// Limits, H100: boxes are 16 bytes of a list that stays in the second-level cache (5.5 TB/s), read by every tile: 10,000 patches
// and the 2,500 tiles of 800 x 800 px are 0.4 GB, 70 us. A face is some 60 operations in float64 (34 TFLOP/s) to set up, by each
// thread of the tile, and 10 to try: with 30 faces near a pixel 45 us.
#include "cuda/api.hpp"
#include "cuda/camera.hpp"
#include "cuda/device.hpp"
#include "math/patch_faces.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kTile = 16, kThreads = kTile * kTile;

struct Boxes {
  float* points;      // (P, K, 3) lattice in the camera, K of `segments`
  int32_t* segments;  // (P,) that are used
  int32_t* boxes;     // (P, 4)
};

__device__ Pinhole<double> camera_of(const PatchViews<float>& in, int64_t view) {
  return load_camera<double>(in.viewmats, in.intrinsics, view, in.width, in.height);
}

struct Corners {
  Vec3<double> at[3];
};
__device__ Corners corners_of(const Boxes& b, int64_t first, const PatchFace& face) {
  Corners found;
  for (int k = 0; k < 3; ++k) {
    const Array<const float> p = global(static_cast<const float*>(b.points)) + 3 * (first + face.corners[k]);
    found.at[k] = {static_cast<double>(p[0]), static_cast<double>(p[1]), static_cast<double>(p[2])};
  }
  return found;
}

__device__ int place_lattice(const PatchViews<float>& in, const Pinhole<double>& cam, int64_t patch, const Boxes& b) {
  const Array<const float> control = global(in.points) + patch * kPatchPoints * 3;
  Vec3<double> points[kPatchPoints];
  for (int k = 0; k < kPatchPoints; ++k) {
    const Vec3<double> p{static_cast<double>(control[3 * k]), static_cast<double>(control[3 * k + 1]),
                         static_cast<double>(control[3 * k + 2])};
    points[k] = to_camera(cam, p);
  }
  const int n = segments_for(cam, static_cast<double>(in.near), in.segments, points);
  const int64_t first = patch * lattice_size(in.segments);
  for (int i = 0; i <= n; ++i) {
    for (int j = 0; i + j <= n; ++j) {
      const auto at = quadratic_weights(static_cast<double>(i) / n, static_cast<double>(j) / n);
      Vec3<double> p{0, 0, 0};
      for (int k = 0; k < kPatchPoints; ++k) p = p + points[k] * at.weight[k];
      const int64_t to = 3 * (first + lattice_index(n, i, j));
      global(b.points)[to] = static_cast<float>(p.x);
      global(b.points)[to + 1] = static_cast<float>(p.y);
      global(b.points)[to + 2] = static_cast<float>(p.z);
    }
  }
  return n;
}

__global__ void __launch_bounds__(kThreads) place_patches_kernel(PatchViews<float> in, int64_t view, Boxes b) {
  const int64_t patch = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (patch >= in.patches) return;
  PixelBox all{in.width, in.height, 0, 0};
  int n = 1;
  if (is_finite_patch<float>(global(in.points) + patch * kPatchPoints * 3)) {
    const Pinhole<double> cam = camera_of(in, view);
    n = place_lattice(in, cam, patch, b);
    for_each_face(n, [&](const PatchFace& face) {
      const Corners corners = corners_of(b, patch * lattice_size(in.segments), face);
      const PixelBox box = pixels_of(cam, static_cast<double>(in.near), corners.at);
      if (box.empty()) return;
      all.x0 = box.x0 < all.x0 ? box.x0 : all.x0, all.y0 = box.y0 < all.y0 ? box.y0 : all.y0;
      all.x1 = box.x1 > all.x1 ? box.x1 : all.x1, all.y1 = box.y1 > all.y1 ? box.y1 : all.y1;
    });
  }
  global(b.segments)[patch] = n;
  const int box[4] = {all.x0, all.y0, all.x1, all.y1};
  for (int k = 0; k < 4; ++k) global(b.boxes)[4 * patch + k] = box[k];
}

// The nearest face at a pixel so far.
struct Nearest {
  double z = kEndless, u = 0, v = 0;
  int32_t patch = -1;
};

__device__ void try_patch(const PatchViews<float>& in, const Pinhole<double>& cam, const Boxes& b, int32_t patch, int x,
                          int y, Nearest& best) {
  const int n = global(b.segments)[patch];
  for_each_face(n, [&](const PatchFace& face) {
    const Corners corners = corners_of(b, int64_t{patch} * lattice_size(in.segments), face);
    const PixelBox box = pixels_of(cam, static_cast<double>(in.near), corners.at);
    if (x < box.x0 || x >= box.x1 || y < box.y0 || y >= box.y1) return;
    const RayTriangle triangle = ray_triangle(corners.at[0], corners.at[1], corners.at[2]);
    if (!triangle.is_drawn()) return;
    double u, v;
    const double z = hit_face(cam, triangle, face, n, x, y, u, v);
    if (z >= static_cast<double>(in.near) && z < best.z) best = {z, u, v, patch};
  });
}

__global__ void __launch_bounds__(kThreads)
    draw_tiles_kernel(PatchViews<float> in, int64_t view, Boxes b, VisiblePatches<float> out) {
  DYNGS_SHARED(int32_t, kept, kThreads);
  const int across = (in.width + kTile - 1) / kTile, thread = static_cast<int>(threadIdx.x);
  const int tile_x = static_cast<int>(blockIdx.x) % across * kTile,
            tile_y = static_cast<int>(blockIdx.x) / across * kTile;
  const int x = tile_x + thread % kTile, y = tile_y + thread / kTile;
  const bool is_inside = x < in.width && y < in.height;
  const Pinhole<double> cam = camera_of(in, view);
  Nearest best;
  for (int64_t first = 0; first < in.patches; first += kThreads) {
    const int64_t patch = first + thread;
    bool meets = patch < in.patches;
    if (meets) {
      const Array<const int32_t> box = global(static_cast<const int32_t*>(b.boxes)) + 4 * patch;
      meets = box[0] < tile_x + kTile && box[2] > tile_x && box[1] < tile_y + kTile && box[3] > tile_y;
    }
    kept[thread] = meets ? static_cast<int32_t>(patch) : -1;
    __syncthreads();
    for (int k = 0; is_inside && k < kThreads; ++k) {
      const int32_t other = kept[k];
      if (other >= 0) try_patch(in, cam, b, other, x, y, best);
    }
    __syncthreads();
  }
  if (!is_inside) return;
  const int64_t pixel = (view * in.height + y) * in.width + x;
  global(out.ids)[pixel] = best.patch;
  global(out.uv)[2 * pixel] = static_cast<float>(best.u);
  global(out.uv)[2 * pixel + 1] = static_cast<float>(best.v);
}

Boxes boxes_in(Workspace& w, const PatchViews<float>& in) {
  return {w.take<float>(3 * in.patches * lattice_size(in.segments)), w.take<int32_t>(in.patches),
          w.take<int32_t>(4 * in.patches)};
}

}  // namespace

int64_t visible_patches_workspace(const PatchViews<float>& in) {
  Workspace w(nullptr, 0);
  boxes_in(w, in);
  return w.taken();
}

void visible_patches(const PatchViews<float>& in, const VisiblePatches<float>& out, const Lent& lent, Stream stream) {
  Workspace workspace(lent.memory, lent.bytes);
  const Boxes b = boxes_in(workspace, in);
  const int64_t tiles = blocks_for(in.width, kTile) * blocks_for(in.height, kTile);
  for (int64_t view = 0; view < in.views; ++view) {
    launch("place_patches", {blocks_for(in.patches, kThreads), kThreads}, stream, place_patches_kernel, in, view, b);
    launch("draw_tiles", {tiles, kThreads}, stream, draw_tiles_kernel, in, view, b, out);
  }
}

}  // namespace dyngs::cuda
