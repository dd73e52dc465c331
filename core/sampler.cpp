// Entry point of core/sampler.hpp, compiled once per instruction set.
#define HW_SAMPLER_KERNEL
#include "sampler.hpp"

namespace hw {
namespace HW_ISA {

int sampler_run(const SamplerArgs& a) { return sampler(a); }

}  // namespace HW_ISA
}  // namespace hw
