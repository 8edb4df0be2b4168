"""Makes the launch of a kernel cheaper, without changing what is launched.

Taichi 1.7 looks at the types of all arguments anew at every launch: a tenth of a millisecond for a
kernel of ten arrays. After the first launch of one of our kernels nothing about them can change but
the arrays themselves, for its annotations fix type and number of dimensions. So a plan is kept: how
each argument is handed over, and the compiled kernel. Whatever does not fit the plan goes the long
way, where Taichi says what is wrong with it.
"""

import ctypes
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

_INTEGERS, _REALS = (int, np.integer), (int, float, np.integer, np.floating)
_LARGEST = 2**31 - 1  # elements of an array: Taichi counts them in 32 bits
_BYTE_OF: Any = ctypes.c_char.from_buffer
_MOST = 60  # arguments, vectors by their elements; Taichi takes 64


class _Plan(NamedTuple):
    kernel: Any
    compiled: Any
    setters: tuple[Callable[[Any, tuple[int, ...], Any], bool], ...]
    """One an argument: hands it over, or says that it does not fit."""


def _address(array: np.ndarray) -> int:
    """Return where the elements of an array are; by way of a buffer that takes a fifth as long."""
    if array.size and array.flags.writeable:
        return ctypes.addressof(_BYTE_OF(array))
    return int(array.__array_interface__["data"][0])


def _array_setter(dtype: np.dtype, ndim: int) -> Callable[[Any, tuple[int, ...], Any], bool]:
    def set_array(context: Any, index: tuple[int, ...], value: Any) -> bool:
        if (
            type(value) is not np.ndarray
            or value.dtype != dtype
            or value.ndim != ndim
            or not value.flags.c_contiguous
            or value.size > _LARGEST
        ):
            return False
        context.set_arg_external_array_with_shape(
            index, _address(value), value.nbytes, value.shape, 0
        )
        return True

    return set_array


def _set_integer(context: Any, index: tuple[int, ...], value: Any) -> bool:
    if not isinstance(value, _INTEGERS):
        return False
    context.set_arg_int(index, int(value))
    return True


def _set_real(context: Any, index: tuple[int, ...], value: Any) -> bool:
    if not isinstance(value, _REALS):
        return False
    context.set_arg_float(index, float(value))
    return True


def _vector_setter(length: int, real: bool) -> Callable[[Any, tuple[int, ...], Any], bool]:
    kinds = _REALS if real else _INTEGERS

    def set_vector(context: Any, index: tuple[int, ...], value: Any) -> bool:
        if not isinstance(value, tuple) or len(value) != length:
            return False
        if not all(isinstance(element, kinds) for element in value):
            return False
        for k, element in enumerate(value):
            if real:
                context.set_struct_arg_float((*index, k), float(element))
            else:
                context.set_struct_arg_int((*index, k), int(element))
        return True

    return set_vector


def _setter(ti: Any, annotation: Any) -> Callable[[Any, tuple[int, ...], Any], bool] | None:
    """Return how an argument is handed over; None for kinds that our kernels do not have."""
    names = {ti.i32: "int32", ti.i64: "int64", ti.f32: "float32", ti.f64: "float64"}
    if isinstance(annotation, ti.types.ndarray_type.NdarrayType):
        if annotation.dtype in names and annotation.ndim is not None:
            return _array_setter(np.dtype(names[annotation.dtype]), annotation.ndim)
        return None
    if isinstance(annotation, ti.lang.matrix.VectorType):
        if annotation.dtype in names:
            return _vector_setter(annotation.n, annotation.dtype in (ti.f32, ti.f64))
        return None
    if any(annotation is kind for kind in (ti.i32, ti.i64)):
        return _set_integer
    if any(annotation is kind for kind in (ti.f32, ti.f64)):
        return _set_real
    return None


def _plan(ti: Any, kernel: Any, program: Any) -> _Plan | None:
    """Return the plan of a kernel that has been launched, None where only the long way will do."""
    setters = [_setter(ti, argument.annotation) for argument in kernel.arguments]
    known = [setter for setter in setters if setter is not None]
    if (
        len(known) < len(setters)
        or len(setters) > _MOST
        or kernel.return_type is not None
        or kernel.has_print
        or program.config().arch != ti.cpu  # a device's arrays are no NumPy arrays: none would fit
        or len(kernel.compiled_kernels) != 1
        or program.config().debug
    ):
        return None
    (compiled_kernel,) = kernel.compiled_kernels.values()
    compiled = program.compile_kernel(program.config(), program.get_device_caps(), compiled_kernel)
    return _Plan(compiled_kernel, compiled, tuple(known))


def speed_up(ti: Any) -> None:
    """Let kernels be launched by plan.

    Args:
        ti: The module ``taichi``, before its first kernel runs.
    """
    kernel_class = ti.lang.kernel_impl.Kernel
    long_way = kernel_class.__call__
    runtime = ti.lang.impl.get_runtime

    def launch(self: Any, *args: Any, **kwargs: Any) -> Any:
        asked, plan = self.__dict__.get("octoseg_plan", (None, None))
        program = runtime().prog
        if asked is None or asked is not program:
            result = long_way(self, *args, **kwargs)
            program = runtime().prog
            self.octoseg_plan = (program, _plan(ti, self, program))
            return result
        if plan is None or kwargs or len(args) != len(plan.setters):
            return long_way(self, *args, **kwargs)
        context = plan.kernel.make_launch_context()
        for k, (setter, value) in enumerate(zip(plan.setters, args, strict=True)):
            if not setter(context, (k,), value):
                return long_way(self, *args, **kwargs)
        program.launch_kernel(plan.compiled, context)
        return None

    kernel_class.__call__ = launch
