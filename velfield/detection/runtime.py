"""onnxruntime: where networks run, and the sessions that run them.

A session has one thread: frames are what is spread over the processors, and the order of its sums never changes.
"""

import re
import sys
import warnings
from contextlib import redirect_stdout, suppress
from functools import cache
from textwrap import shorten
from threading import RLock, get_ident
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper

from schemas.flight import Device
from velfield.errors import DeviceWarning, InputError

_OPSET, _IR_VERSION = 17, 9
"""Versions of the ONNX files that are written: onnxruntime reads them since 1.15."""
STARTING = RLock()
"""Held while a GPU is tried and sessions are opened: several threads at once would each do so."""
_CUDA, _CPU = "CUDAExecutionProvider", "CPUExecutionProvider"
_WARNINGS, _ERRORS, _FATAL = 2, 3, 4
"""onnxruntime's levels of severity. A session's warnings are about how its graph was exported, many lines in each
process; without a session, its warnings and errors are shown."""
_device: Device = "auto"
_limitations_reported = False


def use_device(device: Device) -> None:
    """Set where the networks of this process are run that have not been run yet.

    Its caller reports `Detector.limitations`, which are not warned of any more: each process would repeat them.
    """
    global _device, _limitations_reported
    _device, _limitations_reported = device, True


def current_device() -> Device:
    """The device that `use_device` has set."""
    return _device


def uses_cuda(device: Device) -> bool:
    """Whether networks run on a GPU; without `use_device`, warn once a process where CUDA does not start."""
    if device == "auto" and not _limitations_reported:
        _warn_of_cuda()
    return device != "cpu" and _cuda_fault() is None


def limitations_are_reported() -> bool:
    """Whether `use_device` was called, whose caller reports them."""
    return _limitations_reported


def on_cuda(session: ort.InferenceSession) -> bool:
    """Whether a session runs on a GPU."""
    return _CUDA in session.get_providers()


def device_limitations(device: Device) -> list[str]:
    """Why networks run on the processor, where onnxruntime has CUDA and the processor was not asked for."""
    fault = _cuda_fault() if device == "auto" and _CUDA in ort.get_available_providers() else None
    if fault is None:
        return []
    return [f"found {fault}, {_EXPECTED}: the network runs on the processor; {_REMEDY}"]


_EXPECTED = "expected CUDA, cuDNN and an NVIDIA GPU"
_REMEDY = "pip install velfield[cuda], or use --device cpu"


@cache
def _warn_of_cuda() -> None:
    for text in device_limitations("auto"):
        warnings.warn(text, DeviceWarning, stacklevel=3)


def _cuda_fault() -> str | None:
    """Reason why networks cannot run on a GPU, None if they can: tried once per process."""
    with STARTING:
        return _find_cuda_fault()


class _Captured:
    """Standard output whose lines of this thread are kept; those of others are passed on."""

    def __init__(self) -> None:
        self.printed, self._thread, self._stdout = "", get_ident(), sys.stdout

    def write(self, text: str) -> int:
        if get_ident() != self._thread:
            return self._stdout.write(text)
        self.printed += text
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stdout, name)


_CAUSE = re.compile(r"CUDA failure [^;]*|Failed to load [^\n]*")
"""In what onnxruntime says: without a driver a line of 600 characters, most of them C++."""


@cache
def _find_cuda_fault() -> str | None:
    """By a convolution.

    The package says only what it was compiled for. Without CUDA's libraries its sessions have no CUDA, without a driver
    none is made, and without cuDNN they fail at the first convolution.
    """
    offered = ort.get_available_providers()
    if _CUDA not in offered:
        return f"onnxruntime with {', '.join(offered)}"
    output: Any = _Captured()
    ort.set_default_logger_severity(_FATAL)
    try:
        if hasattr(ort, "preload_dlls"):  # from 1.21 on: those that pip installed, which no loader looks for
            with redirect_stdout(output):  # it prints which libraries it misses
                ort.preload_dlls()
        session = _cuda_session(_probe())
        session.run(None, {"image": np.zeros((1, 1, 8, 8), np.float32)})
        if _CUDA in session.get_providers():
            return None
        why, messages = next(iter(output.printed.strip().splitlines()), "no GPU, or no driver of it"), output.printed
    except Exception as error:  # onnxruntime's own kinds have no common base
        why, messages = str(error).strip().rpartition(" : ")[2], f"{output.printed}\n{error}"
    finally:
        ort.set_default_logger_severity(_WARNINGS)
    cause = _CAUSE.search(messages)
    return f"onnxruntime with CUDA that does not start ({shorten(cause[0] if cause else why, 200)})"


def _cuda_session(model: bytes) -> ort.InferenceSession:
    """A session on a GPU; an error where none starts: onnxruntime's own fallback prints five lines on it."""
    return ort.InferenceSession(model, _session_options(), providers=_providers(gpu=True), enable_fallback=0)


def _probe() -> bytes:
    """A convolution, as an ONNX model."""
    image, out = (helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 1, 8, 8]) for name in ("image", "out"))
    kernel = numpy_helper.from_array(np.ones((1, 1, 3, 3), np.float32), "kernel")
    node = helper.make_node("Conv", ["image", "kernel"], ["out"], pads=[1] * 4)
    return serialize(helper.make_graph([node], "probe", [image], [out], [kernel]))


def check_device(device: Device) -> None:
    """Raise InputError where onnxruntime cannot use a device."""
    fault = _cuda_fault() if device == "cuda" else None
    if fault is not None:
        raise InputError(f"--device cuda: found {fault}, {_EXPECTED}; {_REMEDY}")


def open_session(model: bytes, device: Device) -> ort.InferenceSession:
    """A model in onnxruntime: on one thread of the processor, so that the order of its sums never changes, or on a GPU.

    Raises
    ------
    InputError
        ``device`` is cuda, and onnxruntime cannot use it.
    """
    check_device(device)
    gpu = uses_cuda(device)
    session = None
    if gpu:
        with suppress(Exception):  # onnxruntime's own kinds; a faulty model fails on the processor too
            session = _cuda_session(model)
    if session is None:
        session = ort.InferenceSession(model, _session_options(), providers=_providers(gpu=False))
    if gpu and _CUDA not in session.get_providers():  # though another did: its memory is full
        found = f"a GPU on which no further session starts, {_EXPECTED}"
        if device == "cuda":
            raise InputError(f"--device cuda: found {found}; free its memory, or use --device cpu")
        warnings.warn(
            "GPU unavailable, no further session starts on it: using the CPU; free the GPU's memory",
            DeviceWarning,
            stacklevel=2,
        )
    return session


def _session_options() -> ort.SessionOptions:
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = _ERRORS
    options.enable_cpu_mem_arena = False  # it keeps 150 MB of each thread for ever, and saves no time
    return options


def _providers(*, gpu: bool) -> list[Any]:
    """Execution providers that a session requests, first choice first.

    With TF32's shorter mantissa scores would differ visibly. Trying all of cuDNN's algorithms (EXHAUSTIVE) takes five
    times as long at each new size, and none of them is faster.
    """
    cuda = (_CUDA, {"use_tf32": "0", "cudnn_conv_algo_search": "HEURISTIC"})
    return [cuda, _CPU] if gpu else [_CPU]


def serialize(graph: onnx.GraphProto) -> bytes:
    """A model of a graph, as a file holds it."""
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION, producer_name="velfield"
    )
    return bytes(model.SerializeToString())
