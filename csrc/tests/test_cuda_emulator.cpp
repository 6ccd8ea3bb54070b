// The emulation of CUDA itself: it must give the known values of warp operations, run every block and thread once in every
// order, and detect invalid accesses and races. Each kind of error has a small kernel with it, and one without.
#include <functional>

#include "cuda/device.hpp"
#include "tests/check.hpp"

namespace {

using namespace check;
using namespace dyngs::cuda;
using emulated::machine;
using emulated::Memory;
using Order = emulated::Schedule::Order;

// The error message of a launch, or empty.
std::string failure_of(const std::function<void()>& run) {
  try {
    run();
  } catch (const emulated::Failure& failure) {
    return failure.what();
  }
  return "";
}

void expect_failure(const std::string& words, const std::function<void()>& run) {
  const std::string got = failure_of(run);
  expect(got.find(words) != std::string::npos, "expected \"" + words + "\", got \"" + got + "\"");
}

void expect_fine(const std::string& what, const std::function<void()>& run) {
  const std::string got = failure_of(run);
  expect(got.empty(), what + ": " + got);
}

// Values --------------------------------------------------------------------------------------------------------------

__global__ void number_threads(int* out) {
  const Array<int> numbers = global(out);
  numbers[blockIdx.x * blockDim.x + threadIdx.x] = static_cast<int>(1000 * blockIdx.x + threadIdx.x);
}

void test_every_thread_runs_once() {
  Memory<int> out(5 * 96);
  launch("numbers", {5, 96}, nullptr, number_threads, out.get());
  std::vector<int> wanted;
  for (int b = 0; b < 5; ++b)
    for (int t = 0; t < 96; ++t) wanted.push_back(1000 * b + t);
  expect_same_bits("thread numbers", out.values(), wanted);
}

// Six results per thread of operations with known answers.
__global__ void warp_operations(int* out) {
  const Array<int> results = global(out) + 6 * static_cast<int64_t>(threadIdx.x);
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize;
  results[0] = __shfl_sync(kAllLanes, 10 * lane, 7);
  results[1] = __shfl_xor_sync(kAllLanes, lane, 5);
  results[2] = __shfl_up_sync(kAllLanes, lane, 4);
  results[3] = static_cast<int>(__ballot_sync(kAllLanes, lane % 3 == 0));
  results[4] = static_cast<int>(__match_any_sync(kAllLanes, static_cast<uint32_t>(lane / 8)));
  results[5] = __any_sync(kAllLanes, lane == 31) + 2 * __any_sync(kAllLanes, lane == 99);
}

void test_warp_operations() {
  Memory<int> out(6 * 64);
  launch("warp operations", {1, 64}, nullptr, warp_operations, out.get());
  std::vector<int> wanted;
  for (int t = 0; t < 64; ++t) {
    const int lane = t % 32;
    const auto eight = static_cast<int>(0xffu << (lane / 8 * 8));
    for (int w : {70, lane ^ 5, lane < 4 ? lane : lane - 4, 0x49249249, eight, 1}) wanted.push_back(w);
  }
  expect_same_bits("shuffles, votes and matches", out.values(), wanted);
}

__global__ void sum_up(const float* in, float* out, int64_t n) {
  const Array<const float> numbers = global(in);
  DYNGS_SHARED(float, sums, 64);
  const int me = static_cast<int>(threadIdx.x);
  sums[me] = me < n ? static_cast<float>(numbers[me]) : 0.f;
  for (int step = 32; step > 0; step /= 2) {
    __syncthreads();
    if (me < step) sums[me] += static_cast<float>(sums[me + step]);
  }
  const bool all = __syncthreads_and(me < 64) != 0, none = __syncthreads_and(me < 63) != 0;
  if (me == 0) global(out)[0] = static_cast<float>(sums[0]) + (all ? 1000.f : 0.f) + (none ? 1e6f : 0.f);
}

__global__ void count_all(int* out) { atomic_add(global(out), 0, 1); }

void test_blocks_and_atomics() {
  std::vector<float> numbers(50);
  for (int i = 0; i < 50; ++i) numbers[i] = static_cast<float>(i);
  Memory<float> in(numbers), out(1);
  launch("sum", {1, 64}, nullptr, sum_up, in.get(), out.get(), int64_t{50});
  expect(out.values()[0] == 2225, "sum in shared memory, and votes of a block");
  Memory<int> count(std::vector<int>{0});
  launch("count", {3, 64}, nullptr, count_all, count.get());
  expect(count.values()[0] == 192, "atomics of several blocks");
}

__global__ void note_order(int* next, int* out) {
  const int place = atomic_add(global(next), 0, 1);
  global(out)[place] = static_cast<int>(blockIdx.x * blockDim.x + threadIdx.x);
}

std::vector<int> order_of(Order order, unsigned seed) {
  machine.schedule = {order, seed};
  Memory<int> next(std::vector<int>{0}), out(128);
  launch("order", {2, 64}, nullptr, note_order, next.get(), out.get());
  machine.schedule = {};
  return out.values();
}

void test_orders() {
  const std::vector<int> forward = order_of(Order::kForward, 0), reversed = order_of(Order::kReversed, 0);
  expect(forward.front() == 0 && forward.back() == 127 && reversed.front() == 127 && reversed.back() == 0,
         "forward and reversed order");
  const std::vector<int> shuffled = order_of(Order::kShuffled, 1);
  expect(shuffled != forward && shuffled != order_of(Order::kShuffled, 2), "other seeds are other orders");
  expect(shuffled == order_of(Order::kShuffled, 1), "the same seed is the same order");
}

// Mistakes ------------------------------------------------------------------------------------------------------------

// Each thread passes a number to its neighbour.
enum class Between { kNothing, kBlock, kWarp };

template <Between kBetween>
__global__ void pass_on(int* out) {
  DYNGS_SHARED(int, passed, 64);
  const int me = static_cast<int>(threadIdx.x), size = kBetween == Between::kWarp ? kWarpSize : 64;
  const int other = me / size * size + (me + 1) % size;
  passed[me] = 0;
  __syncthreads();
  passed[me] = me;
  if constexpr (kBetween == Between::kBlock) __syncthreads();
  if constexpr (kBetween == Between::kWarp) __syncwarp();
  global(out)[me] = static_cast<int>(passed[other]);
}

__global__ void pass_on_in_blocks(int* out) {
  DYNGS_SHARED(int, passed, 64);
  const int me = static_cast<int>(threadIdx.x);
  passed[me] = me;
  __syncthreads();
  global(out)[blockIdx.x * 64 + threadIdx.x] = static_cast<int>(passed[(me + 1) % 64]);
}
__global__ void overwrite_shared() {
  DYNGS_SHARED(int, one, 1);
  one[0] = static_cast<int>(threadIdx.x);
}
__global__ void overwrite_read() {
  DYNGS_SHARED(int, one, 1);
  if (threadIdx.x == 0) one[0] = 1;
  __syncthreads();
  const int read = one[0];
  if (threadIdx.x == 40) one[0] = read + 1;
}
__global__ void shuffle_orders_no_memory(int* out) {
  DYNGS_SHARED(int, passed, 32);
  const int me = static_cast<int>(threadIdx.x);
  passed[me] = __shfl_xor_sync(kAllLanes, me, 1);
  const int source = __shfl_sync(kAllLanes, me, 3);
  global(out)[me] = static_cast<int>(passed[source]);
}
__global__ void add_plainly(int* out) { global(out)[0] += 1; }
__global__ void add_and_read(int* out) {
  if (threadIdx.x == 5) atomic_add(global(out), 0, 1);
  if (threadIdx.x == 9) global(out)[1] = static_cast<int>(global(out)[0]);
}
__global__ void read_of_another_block(int* out) {
  if (threadIdx.x == 0) global(out)[blockIdx.x] = static_cast<int>(global(out)[(blockIdx.x + 1) % 2]);
}

void test_races() {
  Memory<int> out(std::vector<int>(64));
  for (const Order order : {Order::kForward, Order::kReversed, Order::kShuffled}) {
    machine.schedule = {order, 3};
    expect_failure("race", [&] { launch("no barrier", {1, 64}, nullptr, pass_on<Between::kNothing>, out.get()); });
    expect_fine("a barrier", [&] { launch("barrier", {1, 64}, nullptr, pass_on<Between::kBlock>, out.get()); });
    Memory<int> of_two(128);
    expect_fine("blocks have shared memory of their own",
                [&] { launch("two blocks", {2, 64}, nullptr, pass_on_in_blocks, of_two.get()); });
    expect_fine("a warp barrier", [&] { launch("warp", {1, 64}, nullptr, pass_on<Between::kWarp>, out.get()); });
    expect_failure("race", [&] { launch("all write", {1, 32}, nullptr, overwrite_shared); });
    expect_failure("race", [&] { launch("write after read", {1, 64}, nullptr, overwrite_read); });
    expect_failure("race", [&] { launch("shuffle", {1, 32}, nullptr, shuffle_orders_no_memory, out.get()); });
    expect_failure("race", [&] { launch("plain sum", {1, 32}, nullptr, add_plainly, out.get()); });
    expect_failure("race", [&] { launch("plain sum", {2, 1}, nullptr, add_plainly, out.get()); });
    expect_failure("race", [&] { launch("atomic and read", {1, 32}, nullptr, add_and_read, out.get()); });
    expect_failure("race", [&] { launch("blocks", {2, 32}, nullptr, read_of_another_block, out.get()); });
  }
  machine.schedule = {};
  expect_failure("no barrier, block 0, thread",
                 [&] { launch("no barrier", {1, 64}, nullptr, pass_on<Between::kNothing>, out.get()); });
  expect_failure("shared passed, byte",
                 [&] { launch("no barrier", {1, 64}, nullptr, pass_on<Between::kNothing>, out.get()); });
}

__global__ void read_at(const float* in, int64_t index, float* out) {
  const float value = global(in)[index];
  global(out)[0] = value;
}
__global__ void write_at(float* out, int64_t index) { global(out)[index] = 1.f; }
__global__ void shared_at(int64_t index) {
  DYNGS_SHARED(float, few, 4);
  few[index] = 1.f;
}
__global__ void read_unwritten(float* out) {
  DYNGS_SHARED(float, few, 4);
  if (blockIdx.x == 0) few[0] = 1.f;
  global(out)[blockIdx.x] = static_cast<float>(few[0]);
}
struct alignas(16) Four {
  float x[4];
};
__global__ void read_four(const float* in, float* out) {
  const Four four = global(reinterpret_cast<const Four*>(in))[0];
  global(out)[0] = four.x[3];
}

void test_bounds() {
  Memory<float> in(std::vector<float>(8), "eight numbers"), out(2);
  expect_fine("the last number", [&] { launch("read", {1, 1}, nullptr, read_at, in.get(), int64_t{7}, out.get()); });
  for (const int64_t index : {int64_t{8}, int64_t{-1}, int64_t{1} << 40})
    expect_failure("out of bounds: eight numbers",
                   [&] { launch("read", {1, 1}, nullptr, read_at, in.get(), index, out.get()); });
  expect_failure("out of bounds", [&] { launch("write", {1, 1}, nullptr, write_at, out.get(), int64_t{2}); });
  expect_failure("out of bounds: shared few", [&] { launch("shared", {1, 1}, nullptr, shared_at, int64_t{4}); });
  expect_failure("read before it was written", [&] {
    Memory<float> fresh(4);
    launch("read", {1, 1}, nullptr, read_at, fresh.get(), int64_t{0}, out.get());
  });
  expect_failure("block 1", [&] { launch("unwritten", {2, 1}, nullptr, read_unwritten, out.get()); });
  expect_failure("not in any allocation", [&] {
    const float stray = 0;
    launch("stray", {1, 1}, nullptr, read_at, &stray, int64_t{0}, out.get());
  });
  expect_failure("misaligned", [&] {
    const int64_t odd = reinterpret_cast<uintptr_t>(in.get()) % 16 == 0 ? 1 : 0;
    launch("four", {1, 1}, nullptr, read_four, in.get() + odd, out.get());
  });
}

void test_parts_of_a_workspace() {
  Memory<char> memory(4096);
  Workspace counted(nullptr, 0), cut(memory.get(), 4096);
  expect(counted.take<float>(3) == nullptr, "a workspace without memory only counts");
  counted.take<double>(5);
  float* first = cut.take<float>(3);
  cut.take<double>(5);
  expect(counted.taken() == cut.taken(), "counted as cut");
  expect_fine("inside", [&] { launch("inside", {1, 1}, nullptr, write_at, first, int64_t{2}); });
  expect_failure("out of bounds", [&] { launch("between", {1, 1}, nullptr, write_at, first, int64_t{3}); });
  bool refused = false;
  try {
    cut.take<float>(2000);
  } catch (const std::length_error&) {
    refused = true;
  }
  expect(refused, "a workspace that is too small is refused");
}

__global__ void half_waits() {
  if (threadIdx.x < 32) __syncthreads();
}
__global__ void two_barriers() {
  if (threadIdx.x < 32) {
    __syncthreads();
  } else {
    __syncthreads();
  }
}
__global__ void half_a_warp(int* out) {
  if (threadIdx.x < 16) global(out)[threadIdx.x] = __shfl_sync(kAllLanes, 1, 0);
}
__global__ void half_masks(int* out) {
  const int lane = static_cast<int>(threadIdx.x);
  const int of_half = lane < 16 ? __shfl_sync(0x0000ffffu, lane, 3) : __shfl_sync(0xffff0000u, lane, 20);
  global(out)[lane] = of_half;
}
__global__ void from_the_other_half(int* out) {
  if (threadIdx.x < 16) global(out)[threadIdx.x] = __shfl_sync(0x0000ffffu, 1, 20);
}
__global__ void much_shared() {
  DYNGS_SHARED(double, much, 7000);
  much[threadIdx.x] = 0.;
}
__global__ void dynamic_shared(int* out) {
  DYNGS_DYNAMIC_SHARED(int, numbers);
  numbers[threadIdx.x] = static_cast<int>(threadIdx.x);
  __syncthreads();
  global(out)[threadIdx.x] = static_cast<int>(numbers[31 - threadIdx.x]);
}

void test_barriers_and_shared_memory() {
  Memory<int> out(32);
  expect_failure("deadlock, 32 of 64 threads wait", [&] { launch("half", {1, 64}, nullptr, half_waits); });
  expect_failure("__syncthreads of lines", [&] { launch("two", {1, 64}, nullptr, two_barriers); });
  expect_failure("lanes that do not come", [&] { launch("half a warp", {1, 32}, nullptr, half_a_warp, out.get()); });
  expect_fine("masks", [&] { launch("masks", {1, 32}, nullptr, half_masks, out.get()); });
  expect(out.values()[5] == 3 && out.values()[30] == 20, "each half of a warp shuffles alone");
  expect_failure("does not take part", [&] { launch("other", {1, 32}, nullptr, from_the_other_half, out.get()); });
  expect_failure("shared memory", [&] { launch("much", {1, 32}, nullptr, much_shared); });
  expect_fine("dynamic shared memory",
              [&] { launch("dynamic", {1, 32, 32 * sizeof(int)}, nullptr, dynamic_shared, out.get()); });
  expect(out.values()[0] == 31, "dynamic shared memory");
  expect_failure("out of bounds", [&] { launch("dynamic", {1, 32, 64}, nullptr, dynamic_shared, out.get()); });
  expect_failure("no GPU takes", [&] { launch("threads", {1, 2048}, nullptr, half_waits); });
}

}  // namespace

int main() {
  test_every_thread_runs_once();
  test_warp_operations();
  test_blocks_and_atomics();
  test_orders();
  test_races();
  test_bounds();
  test_parts_of_a_workspace();
  test_barriers_and_shared_memory();
  return report();
}
