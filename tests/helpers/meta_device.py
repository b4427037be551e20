"""Tensors of the device "meta", without values: what a CUDA graph can capture asks for none."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

# What makes the host wait for the device, or gives a shape that depends on values: by name in Python and in ATen.
ASKING = {
    *("item", "tolist", "numpy", "cpu", "__bool__", "__int__", "__float__", "__index__"),
    *("tensor", "new_tensor", "as_tensor", "from_numpy"),
    *("linalg_inv", "linalg_solve", "linalg_svd", "linalg_eigh", "linalg_cholesky", "inverse"),
}
ASKING_ATEN = {
    *("_local_scalar_dense", "nonzero", "masked_select", "bincount", "repeat_interleave"),
    *("_unique2", "unique_dim", "unique_consecutive"),
}


class _RefuseOperations(TorchDispatchMode):
    """Refuses operations of ATen that ask the device or use arrays of the CPU, wherever they are called from."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        assert name not in ASKING_ATEN, f"{func} waits for the device"
        result = func(*args, **(kwargs or {}))
        for value in tree_leaves((args, kwargs, result)):
            known = not isinstance(value, Tensor) or value.device.type == "meta" or value.dim() == 0
            assert known, f"{func}: on the CPU"
        return result


class _RefuseFunctions(TorchFunctionMode):
    """Refuses functions of Python that ask the device or copy from the host: on the CPU ATen does not show them."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        assert getattr(func, "__name__", "") not in ASKING, f"{func} waits for the device"
        return func(*args, **(kwargs or {}))


@contextmanager
def asking_nothing(*, watched: bool = True) -> Iterator[None]:
    """Context for such tensors in which, if ``watched``, nothing may ask the device or use arrays of the CPU."""
    with _RefuseFunctions() if watched else nullcontext(), _RefuseOperations() if watched else nullcontext():
        yield
