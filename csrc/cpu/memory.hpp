// How much memory is left.
#pragma once

#include <cstdint>
#include <string>

namespace dyngs {

// Bytes that this process can still take: the least of what the machine, the control groups and RLIMIT_AS leave it. Takes
// about 0.1 ms. 16 GiB where the system is not Linux and nobody is asked. `root` stands before /proc and /sys, for tests.
int64_t available_memory(const std::string& root = "");

// "12.3 GB", for messages.
std::string gigabytes(int64_t bytes);

}  // namespace dyngs
