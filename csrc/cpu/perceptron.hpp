// A small multilayer perceptron over many rows, fused: all layers of a block of rows before the next block.
#pragma once

#include <cstdint>
#include <vector>

namespace dyngs {

// ReLU after every layer but the last. Layer l maps in(l) to out(l) features: y = W h + b.
template <class S>
struct Perceptron {
  std::vector<int64_t> widths;  // of the input, then of every layer; each at least 1
  int64_t skip;                 // layer whose input is the hidden activations followed by x, or 0 for none
  const S* params;              // for every layer the weight (out, in), then the bias (out)
  int threads;

  int64_t layers() const { return static_cast<int64_t>(widths.size()) - 1; }
  int64_t hidden(int64_t l) const { return widths[l]; }
  int64_t in(int64_t l) const { return widths[l] + (l > 0 && l == skip ? widths[0] : 0); }
  int64_t out(int64_t l) const { return widths[l + 1]; }
  int64_t num_params() const;
  // Scalars per row that the forward pass can keep for the backward pass: the padded inputs of all layers but the first.
  int64_t kept_per_row() const;
};

// Writes y (rows, out). `kept` receives rows * kept_per_row() scalars, or is nullptr.
template <class S>
void perceptron_forward(const Perceptron<S>& net, int64_t rows, const S* x, S* y, S* kept);

// Writes the gradients by x (rows, in), unless that is nullptr, and by params. `kept` is what forward wrote, or nullptr:
// the activations are then computed again, to the same bits. No result depends on the number of threads.
template <class S>
void perceptron_backward(const Perceptron<S>& net, int64_t rows, const S* x, const S* grad_y, const S* kept, S* grad_x,
                         S* grad_params);

}  // namespace dyngs
