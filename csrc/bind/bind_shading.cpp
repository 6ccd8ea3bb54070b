// Python bindings of a colour network's inputs. Argument unpacking only.
#include <algorithm>

#include "bind/arrays.hpp"
#include "core/api.hpp"

namespace dyngs {
namespace {

template <class S>
void write_inputs(const std::tuple<Rows<const S>, Rows<const S>, Rows<const S>>& geometry,
                  const Array<const int64_t, nb::ndim<1>>& picked, const Rows<const S>& base, const Rows<const S>& eye,
                  const Rows<const S>& box, const std::optional<std::tuple<Rows<const S>, Rows<const S>>>& frame,
                  std::optional<double> time, bool normals, const Rows<S>& out, int threads) {
  const auto& [means, quats, log_scales] = geometry;
  const size_t n = means.shape(0), rows = picked.shape(0);
  const auto wrong = [n](int64_t i) { return i < 0 || i >= static_cast<int64_t>(n); };
  if (!kOnGpu && std::any_of(picked.data(), picked.data() + rows, wrong))
    throw nb::index_error("shading: no such Gaussian");
  const Shading<S> in{static_cast<int64_t>(rows),
                      picked.data(),
                      checked(means, n, 3, "shading"),
                      checked(quats, n, 4, "shading"),
                      checked(log_scales, n, 3, "shading"),
                      checked(base, rows, 3, "shading"),
                      checked(eye, 1, 3, "shading"),
                      checked(box, 2, 3, "shading"),
                      frame ? checked(std::get<0>(*frame), n, 3, "shading") : nullptr,
                      frame ? checked(std::get<1>(*frame), 3, 3, "shading") : nullptr,
                      normals,
                      time.has_value(),
                      static_cast<S>(time.value_or(0)),
                      threads};
  if (out.shape(0) != rows || static_cast<int64_t>(out.shape(1)) != in.width())
    throw nb::value_error("shading: arrays of different sizes");
  nb::gil_scoped_release release;
  shading_inputs(in, out.data());
}

}  // namespace

void bind_shading(nb::module_& module) {
  for_each_scalar([&]<class S>() { module.def("shading_inputs", write_inputs<S>); });
}

}  // namespace dyngs
