// Tests for the x86-64 levels that this processor runs. By features, because older Clang does not know the levels by name;
// those named here come with all others of their level on every processor made so far.
#pragma once

namespace dyngs {

inline bool runs_v3() {
#if defined(__x86_64__)
  __builtin_cpu_init();
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
         __builtin_cpu_supports("bmi2");
#else
  return false;
#endif
}

inline bool runs_v4() {
#if defined(__x86_64__)
  return runs_v3() && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
         __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
#else
  return false;
#endif
}

// The newest level that this processor runs; v2, the baseline, is not tested.
inline const char* best_isa() { return runs_v4() ? "v4" : runs_v3() ? "v3" : "v2"; }

}  // namespace dyngs
