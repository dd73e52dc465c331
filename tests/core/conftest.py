"""What the tests of the kernels share."""

import pytest

from halfwidth import _core


@pytest.fixture(params=["avx2", "base"])
def isa(request):
    """Both builds of the kernels, where this machine can run them."""
    was = _core.isa()
    if not _core.use_isa(request.param == "avx2"):
        pytest.skip("this machine has no AVX2")
    yield request.param
    _core.use_isa(was == "avx2")
