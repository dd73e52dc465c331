// Entry points of the structured linear program (core/banded_ipm.hpp), one per instruction set.
#pragma once

#include "isa.hpp"
#include "lp_types.hpp"

// bytes of workspace `lp_solve` needs, 64-byte aligned
HW_KERNEL(std::size_t, lp_workspace, const LpProblem& lp, const LpSettings& set)
// returns LpStatus; nothing is allocated
HW_KERNEL(int, lp_solve, const LpProblem& lp, const LpSettings& set, LpOut& out, void* workspace)
// the bytes the longest window needs, and the run over all rows; returns how many windows were not solved
HW_KERNEL(std::size_t, lp_windows_workspace, const LpWindows& win, const LpSettings& set)
HW_KERNEL(int, lp_windows, const LpWindows& win, const LpSettings& set, void* workspace)
