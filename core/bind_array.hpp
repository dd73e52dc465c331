// Arrays that bindings give to Python.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <initializer_list>
#include <new>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace nb = nanobind;

namespace {

// A fresh float64 array. Large ones ask for huge pages: a first write then costs one fault per 2 MB, not per 4 KB.
struct Fresh {
    double* a = nullptr;
    nb::object array;
    explicit Fresh(std::initializer_list<std::int64_t> shape, bool zero = false) {
        std::size_t s[4], n = 1, d = 0;
        for (auto v : shape) {
            s[d++] = static_cast<std::size_t>(v);
            n *= static_cast<std::size_t>(v);
        }
        const std::size_t bytes = (n ? n : 1) * sizeof(double), huge = std::size_t{1} << 21;
        void* p = nullptr;
        if (posix_memalign(&p, bytes >= huge ? huge : 64, bytes) != 0) throw std::bad_alloc();
#ifdef MADV_HUGEPAGE
        if (bytes >= huge) madvise(p, bytes, MADV_HUGEPAGE);
#endif
        a = static_cast<double*>(p);
        if (zero) for (std::size_t i = 0; i < n; i++) a[i] = 0.0;
        nb::capsule owner(p, [](void* q) noexcept { std::free(q); });
        array = nb::cast(nb::ndarray<nb::numpy, double>(a, d, s, owner));
    }
};

// A fresh array of zeros, or of what `from` holds; its memory to `data`.
template <class T>
nb::object fresh(std::initializer_list<std::size_t> shape, T** data, const T* from = nullptr) {
    std::size_t count = 1;
    for (std::size_t s : shape) count *= s;
    T* p = new T[count > 0 ? count : 1]();
    if (from && count) std::memcpy(p, from, count * sizeof(T));
    nb::capsule owner(p, [](void* q) noexcept { delete[] static_cast<T*>(q); });
    *data = p;
    return nb::cast(nb::ndarray<nb::numpy, T>(p, shape, owner));
}

}  // namespace
