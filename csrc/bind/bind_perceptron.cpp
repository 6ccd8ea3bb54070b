// Python bindings of the fused multilayer perceptron. Argument unpacking only.
#include <nanobind/stl/vector.h>

#include <vector>

#include "bind/arrays.hpp"
#include "core/api.hpp"

namespace dyngs {
namespace {

constexpr int64_t kMaxWidth = 1 << 24;  // so that products of two fit 64 bits

void check_widths(const std::vector<int64_t>& widths, int64_t skip) {
  if (widths.size() < 2) throw nb::value_error("perceptron: no layers");
  for (const int64_t width : widths)
    if (width < 1 || width > kMaxWidth) throw nb::value_error("perceptron: a width below 1 or above 2^24");
  if (skip < 0 || skip >= static_cast<int64_t>(widths.size()) - 1)
    throw nb::value_error("perceptron: no such layer to skip to");
}

template <class S>
Perceptron<S> network(const std::vector<int64_t>& widths, int64_t skip, const Array<const S>& params, int threads) {
  check_widths(widths, skip);
  return {widths, skip, params.data(), threads};
}

template <class S>
void forward(Array<const S> x, Array<const S> params, Array<S> y, MaybeArray<S> kept,
             const std::vector<int64_t>& widths, int64_t skip, int threads) {
  const Perceptron<S> net = network(widths, skip, params, threads);
  const int64_t rows = x.size() / widths.front();
  checked(params, net.num_params(), "perceptron: params");
  const S* from = checked(x, rows * widths.front(), "perceptron: x");
  S* to = checked(y, rows * widths.back(), "perceptron: y");
  S* keep = checked(kept, rows * net.kept_per_row(), "perceptron: kept");
  nb::gil_scoped_release release;
  perceptron_forward(net, rows, from, to, keep);
}

template <class S>
void backward(Array<const S> x, Array<const S> params, Array<const S> grad_y, MaybeArray<const S> kept,
              MaybeArray<S> grad_x, Array<S> grad_params, const std::vector<int64_t>& widths, int64_t skip,
              int threads) {
  const Perceptron<S> net = network(widths, skip, params, threads);
  const int64_t rows = x.size() / widths.front();
  checked(params, net.num_params(), "perceptron: params");
  const S* from = checked(x, rows * widths.front(), "perceptron: x");
  const S* grad = checked(grad_y, rows * widths.back(), "perceptron: grad_y");
  const S* keep = checked(kept, rows * net.kept_per_row(), "perceptron: kept");
  S* to_x = checked(grad_x, rows * widths.front(), "perceptron: grad_x");
  S* to_params = checked(grad_params, net.num_params(), "perceptron: grad_params");
  nb::gil_scoped_release release;
  perceptron_backward(net, rows, from, grad, keep, to_x, to_params);
}

template <class S>
void bind_perceptron_of(nb::module_& module) {
  module.def("perceptron_forward", forward<S>, array("x"), array("params"), array("y"), array("kept").none(),
             nb::arg("widths"), nb::arg("skip"), nb::arg("num_threads"),
             "Writes the outputs of (M, K) rows, and what the backward pass can use again.");
  module.def("perceptron_backward", backward<S>, array("x"), array("params"), array("grad_y"), array("kept").none(),
             array("grad_x").none(), array("grad_params"), nb::arg("widths"), nb::arg("skip"), nb::arg("num_threads"),
             "Writes the gradients by the rows and by the parameters.");
}

}  // namespace

void bind_perceptron(nb::module_& module) {
  module.def(
      "perceptron_kept_per_row",
      [](const std::vector<int64_t>& widths, int64_t skip) {
        check_widths(widths, skip);
        return Perceptron<float>{widths, skip, nullptr, 1}.kept_per_row();
      },
      nb::arg("widths"), nb::arg("skip"), "Scalars per row that the forward pass can keep for the backward pass.");
  for_each_scalar([&]<class S>() { bind_perceptron_of<S>(module); });
}

}  // namespace dyngs
