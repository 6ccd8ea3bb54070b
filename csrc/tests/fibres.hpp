// Fibres: functions with stacks of their own that hand control to each other (cuda_on_cpu.hpp has one per CUDA thread). On
// x86-64 a few instructions, since a block of 256 threads changes hands millions of times; elsewhere POSIX ucontext.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <vector>

#if defined(__x86_64__) && !defined(DYNGS_UCONTEXT)
#define DYNGS_OWN_SWITCH 1
#else
#include <ucontext.h>
#endif
#if defined(__SANITIZE_ADDRESS__)
#define DYNGS_ASAN 1
#elif defined(__has_feature)
#if __has_feature(address_sanitizer)
#define DYNGS_ASAN 1
#endif
#endif
#if defined(DYNGS_ASAN)
#include <sanitizer/asan_interface.h>
#include <sanitizer/common_interface_defs.h>
#endif

#if defined(DYNGS_OWN_SWITCH)
// Saves what a function must preserve and the stack pointer in *from, and goes on where `to` was saved.
extern "C" void dyngs_switch_stacks(void** from, void* to);
asm(R"(
.text
.weak dyngs_switch_stacks
.type dyngs_switch_stacks, @function
dyngs_switch_stacks:
  pushq %rbp
  pushq %rbx
  pushq %r12
  pushq %r13
  pushq %r14
  pushq %r15
  movq %rsp, (%rdi)
  movq %rsi, %rsp
  popq %r15
  popq %r14
  popq %r13
  popq %r12
  popq %rbx
  popq %rbp
  ret
.size dyngs_switch_stacks, .-dyngs_switch_stacks
)");
#endif

namespace dyngs::cuda::emulated {

class Fibres {
 public:
  using Main = void (*)();

  // `count` fibres that will run `main`, which must not return; those of before are dropped without cleaning up.
  void prepare(int count, Main main) {
    main_ = main, self_ = this;
    while (static_cast<int>(contexts_.size()) < count) {
      contexts_.push_back({});
      contexts_.back().stack = std::unique_ptr<char[]>(new char[kStackBytes]);
    }
    for (int i = 0; i < count; ++i) start(contexts_[i]);
  }
  // From the caller's stack into a fibre; returns when a fibre leaves.
  void enter(int to) { change(caller_, contexts_[to]); }
  void transfer(int from, int to) { change(contexts_[from], contexts_[to]); }
  void leave(int from) { change(contexts_[from], caller_); }

 private:
  static constexpr size_t kStackBytes = 128 << 10;  // sanitizers widen frames

  struct Context {
    std::unique_ptr<char[]> stack;
#if defined(DYNGS_OWN_SWITCH)
    void* pointer = nullptr;
#else
    ucontext_t state{};
#endif
#if defined(DYNGS_ASAN)
    void* fake_stack = nullptr;
#endif
  };

  static inline Fibres* self_ = nullptr;
  Main main_ = nullptr;
  std::vector<Context> contexts_;
  Context caller_;
  [[maybe_unused]] const void* caller_stack_ = nullptr;  // for AddressSanitizer
  [[maybe_unused]] size_t caller_bytes_ = 0;

  static void begin() {
#if defined(DYNGS_ASAN)
    const void* bottom = nullptr;
    size_t bytes = 0;
    __sanitizer_finish_switch_fiber(nullptr, &bottom, &bytes);
    if (self_->caller_bytes_ == 0) self_->caller_stack_ = bottom, self_->caller_bytes_ = bytes;
#endif
    self_->main_();
  }

  static void start(Context& context) {
#if defined(DYNGS_ASAN)
    __asan_unpoison_memory_region(context.stack.get(), kStackBytes);
#endif
#if defined(DYNGS_OWN_SWITCH)
    // The layout that dyngs_switch_stacks leaves: six registers, then the return address. A function expects the stack
    // pointer 8 bytes off a multiple of 16, as after a call.
    char* end = context.stack.get() + kStackBytes;
    end -= reinterpret_cast<uintptr_t>(end) % 16;
    uintptr_t slots[8] = {};
    slots[6] = reinterpret_cast<uintptr_t>(&begin);
    context.pointer = end - sizeof slots;
    std::memcpy(context.pointer, slots, sizeof slots);
#else
    getcontext(&context.state);
    context.state.uc_stack.ss_sp = context.stack.get();
    context.state.uc_stack.ss_size = kStackBytes;
    context.state.uc_link = nullptr;
    makecontext(&context.state, &begin, 0);
#endif
  }

  void change(Context& from, Context& to) {
#if defined(DYNGS_ASAN)
    const void* bottom = &to == &caller_ ? caller_stack_ : to.stack.get();
    __sanitizer_start_switch_fiber(&from.fake_stack, bottom, &to == &caller_ ? caller_bytes_ : kStackBytes);
#endif
#if defined(DYNGS_OWN_SWITCH)
    dyngs_switch_stacks(&from.pointer, to.pointer);
#else
    swapcontext(&from.state, &to.state);
#endif
#if defined(DYNGS_ASAN)
    __sanitizer_finish_switch_fiber(from.fake_stack, nullptr, nullptr);
#endif
  }
};

}  // namespace dyngs::cuda::emulated
