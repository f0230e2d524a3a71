"""Where networks run: sessions that start on a GPU, that fall back to the processor, and packages without CUDA."""

import sys
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnxruntime
import pytest

from schemas.arrays import GreyImage
from schemas.detector import CnnConfig
from schemas.flight import Device
from tests.detection.test_onnx import tiny_yolo
from velfield.detection import runtime as sessions
from velfield.detection.cnn.graph import network_to_onnx
from velfield.detection.cnn.inference import Predictor, predict_crops, predict_heatmap
from velfield.detection.registry import shipped_detector
from velfield.errors import DeviceWarning, InputError
from velfield.pipeline import given_files

CUDA, CPU = "CUDAExecutionProvider", "CPUExecutionProvider"
NO_DRIVER = (
    "/onnxruntime_src/onnxruntime/core/providers/cuda/cuda_call.cc:129 std::conditional_t<THRW, void, "
    "onnxruntime::common::Status> onnxruntime::CudaCall(ERRTYPE, const char*, const char*, SUCCTYPE, const char*, "
    "const char*, int) [with ERRTYPE = cudaError; bool THRW = true; SUCCTYPE = cudaError] CUDA failure 35: CUDA driver "
    "version is insufficient for CUDA runtime version ; GPU=-1 ; hostname=ed12 ; file=/onnxruntime_src/onnxruntime/"
    "core/providers/cuda/cuda_execution_provider.cc ; line=282 ; expr=cudaSetDevice(info_.device_id);"
)
"""What a session raises with CUDA's libraries and no driver."""


class Runtime:
    """An onnxruntime that offers CUDA; its sessions run on the processor and say that they got what ``starts``."""

    def __init__(self) -> None:
        self.offered, self.starts, self.missing, self.fails, self.refuses = [CUDA, CPU], True, "", "", ""
        self.takes_s, self.most = 0.0, 1000
        """Sessions that a GPU has room for."""
        self.asked: list[list[Any]] = []
        self.preloaded = 0

    def session(
        self, model: bytes, options: Any, providers: list[Any], enable_fallback: int = 1
    ) -> onnxruntime.InferenceSession:
        gpu = providers != [CPU]
        assert self.preloaded or not gpu, "libraries are loaded before the first session"
        self.asked.append(providers)
        refused = self.refuses or ("CUDA failure 2: out of memory ; GPU=0" if len(self.asked) > self.most else "")
        if gpu and refused:  # as onnxruntime_inference_collection.py does
            if not enable_fallback:
                raise RuntimeError(refused)
            print("*************** EP Error ***************", f"EP Error {refused} when using {providers}", sep="\n")
            gpu = False
        session = onnxruntime.InferenceSession(model, options, providers=[CPU])
        session.get_providers = lambda: [CUDA, CPU] if gpu and self.starts else [CPU]
        if gpu and self.fails:
            session.run = self.fail
        return session

    def fail(self, *_: Any) -> None:
        raise RuntimeError(self.fails)

    def preload(self) -> None:
        self.preloaded += 1
        time.sleep(self.takes_s)
        if self.missing:
            print(self.missing, "see https://onnxruntime.ai", sep="\n")


class Stub:
    """onnxruntime with these in place of its own."""

    def __init__(self, runtime: Runtime) -> None:
        self.InferenceSession, self.preload_dlls = runtime.session, runtime.preload
        self.get_available_providers = lambda: runtime.offered

    def __getattr__(self, name: str) -> Any:
        return getattr(onnxruntime, name)


@pytest.fixture
def runtime(monkeypatch: pytest.MonkeyPatch) -> Iterator[Runtime]:
    found = Runtime()
    monkeypatch.setattr(sessions, "ort", Stub(found))
    monkeypatch.setattr(sessions, "_device", "auto")
    monkeypatch.setattr(sessions, "_limitations_reported", False)
    caches = sessions._find_cuda_fault, sessions._warn_of_cuda
    for cache in caches:
        cache.cache_clear()
    yield found
    for cache in caches:
        cache.cache_clear()


def in_floating_point() -> Predictor:
    return Predictor(shipped_detector().network)


def image(seed: int = 0) -> GreyImage:
    return np.random.default_rng(seed).integers(0, 256, (96, 128)).astype(np.uint8)


@pytest.mark.parametrize(("device", "gpu"), [("auto", True), ("cuda", True), ("cpu", False)])
def test_a_gpu_runs_the_network_where_there_is_one_and_it_may(runtime: Runtime, device: Device, gpu: bool) -> None:
    sessions.check_device(device)
    session = sessions.open_session(network_to_onnx(shipped_detector().network), device)
    assert (CUDA in session.get_providers()) == gpu == sessions.uses_cuda(device)
    assert runtime.asked[-1][-1] == CPU
    assert sessions.device_limitations(device) == []
    if gpu:
        name, options = runtime.asked[-1][0]
        assert (name, options["use_tf32"], options["cudnn_conv_algo_search"]) == (CUDA, "0", "HEURISTIC")


def test_a_gpu_is_tried_once_a_process_and_never_where_only_the_processor_may(runtime: Runtime) -> None:
    assert not sessions.uses_cuda("cpu")
    assert (runtime.preloaded, runtime.asked) == (0, [])
    assert [sessions.uses_cuda(device) for device in ("auto", "cuda", "auto")] == [True] * 3
    assert (runtime.preloaded, len(runtime.asked)) == (1, 1)


def test_on_a_gpu_all_runs_in_floating_point_on_images_of_one_size(
    runtime: Runtime, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the ranges of a flight too, by which it would be run in 8 bits on a processor."""
    detector = shipped_detector().for_flight([image()], CnnConfig())
    predict, sizes = detector.predictor, set()
    assert sessions.on_cuda(predict.session)
    assert detector.limitations == []
    run = predict.session.run
    monkeypatch.setattr(predict.session, "run", lambda _, of: sizes.add(of["image"].shape) or run(None, of))
    whole = np.random.default_rng(1).integers(0, 256, (300, 1200)).astype(np.uint8)
    found = predict_heatmap(predict, whole)
    crops = np.array([(0, 0, 96, 96), (96, 200, 48, 64)])
    np.testing.assert_array_equal(predict_crops(predict, whole, crops)[0], found[0])
    assert sizes == {(1, 1, 1216, 1216)}
    sessions.use_device("cpu")
    expected = predict_heatmap(in_floating_point(), whole)
    inner = np.s_[..., 48:102, 48:552]  # farther from the edge than the network sees
    for of_gpu, plain in zip(found[:2], expected[:2], strict=True):
        np.testing.assert_allclose(of_gpu[inner], plain[inner], atol=1e-4)
    np.testing.assert_allclose(found[2][:, 24:51, 24:276], expected[2][:, 24:51, 24:276], atol=1e-4)


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        ({"starts": False}, "no GPU"),
        (
            {"starts": False, "missing": "Failed to load libcublas.so.13: no such file"},
            "Failed to load libcublas.so.13",
        ),
        ({"refuses": NO_DRIVER}, "CUDA failure 35: CUDA driver version is insufficient for CUDA runtime version)"),
        ({"fails": "[ONNXRuntimeError] : 9 : NOT_IMPLEMENTED : cuDNN is not available.\n"}, "cuDNN is not available"),
    ],
)
@pytest.mark.usefixtures("exact")
def test_cuda_that_does_not_start_is_told_once_and_the_processor_runs_8_bits(
    runtime: Runtime, fault: dict[str, Any], why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    vars(runtime).update(fault)
    detector = shipped_detector().for_flight([image()], CnnConfig())
    with pytest.warns(DeviceWarning) as told:
        found = detector.predictor(image()[None])
    assert len(told) == 1
    message = str(told[0].message)
    assert "\n" not in message
    assert f"found onnxruntime with CUDA that does not start ({why}" in message
    assert "expected CUDA, cuDNN and an NVIDIA GPU: the network runs on the processor; pip install" in message
    assert capsys.readouterr().out == ""
    assert not sessions.on_cuda(detector.predictor.session)
    assert message in detector.limitations
    sessions.use_device("cpu")
    again = shipped_detector().for_flight([image()], CnnConfig())
    np.testing.assert_array_equal(found[0], again.predictor(image()[None])[0])
    with pytest.raises(InputError, match="--device cuda: found onnxruntime with CUDA that does not start") as refused:
        sessions.check_device("cuda")
    assert why in str(refused.value)


def test_without_cuda_in_the_package_it_is_refused_and_auto_is_the_processor(runtime: Runtime) -> None:
    runtime.offered = ["AzureExecutionProvider", CPU]
    with pytest.raises(InputError, match=r"--device cuda: found onnxruntime with Azure.*pip install velfield\[cuda\]"):
        sessions.open_session(b"", "cuda")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not sessions.uses_cuda("auto")
        assert not sessions.on_cuda(in_floating_point().session)
    assert sessions.device_limitations("auto") == []
    assert (runtime.preloaded, runtime.asked) == (0, [[CPU]])


def test_an_onnxruntime_that_preloads_nothing_is_tried_as_it_is(
    runtime: Runtime, monkeypatch: pytest.MonkeyPatch
) -> None:
    runtime.preloaded = 1
    monkeypatch.setattr(sessions.ort, "preload_dlls", None)
    monkeypatch.delattr(sessions.ort, "preload_dlls")
    assert sessions.uses_cuda("auto") or not hasattr(onnxruntime, "preload_dlls")


def test_a_session_that_a_full_gpu_refuses_is_no_silent_fallback(runtime: Runtime) -> None:
    model = network_to_onnx(shipped_detector().network)
    assert sessions.uses_cuda("auto")
    runtime.starts = False
    with pytest.warns(DeviceWarning, match="GPU unavailable, no further session starts on it: using the CPU"):
        sessions.open_session(model, "auto")
    with pytest.raises(InputError, match="--device cuda: found a GPU on which no further session starts"):
        sessions.open_session(model, "cuda")


@pytest.mark.usefixtures("exact")
def test_on_a_full_gpu_all_runs_in_8_bits_on_the_processor(
    runtime: Runtime, capsys: pytest.CaptureFixture[str]
) -> None:
    detector = shipped_detector().for_flight([image()], CnnConfig())
    runtime.most = len(runtime.asked) + 1  # the probe
    with pytest.warns(DeviceWarning, match="no further session starts"):
        found = detector.predictor(image()[None])
    assert not sessions.on_cuda(detector.predictor.session)
    assert capsys.readouterr().out == ""
    sessions.use_device("cpu")
    again = shipped_detector().for_flight([image()], CnnConfig())
    np.testing.assert_array_equal(found[0], again.predictor(image()[None])[0])


def test_threads_at_once_try_a_gpu_once_and_what_others_print_is_printed(
    runtime: Runtime, capsys: pytest.CaptureFixture[str]
) -> None:
    runtime.takes_s, stdout, network = 0.2, sys.stdout, in_floating_point()
    with ThreadPoolExecutor(3) as pool:
        found = [pool.submit(lambda: network.session) for _ in range(2)]
        time.sleep(0.1)
        pool.submit(print, "of another thread").result()
    assert sys.stdout is stdout
    assert capsys.readouterr().out == "of another thread\n"
    assert found[0].result() is found[1].result() is not None
    assert (runtime.preloaded, len(runtime.asked)) == (1, 2)


def test_what_a_stage_says_is_not_warned_of_too(runtime: Runtime, tmp_path: Path) -> None:
    """For another maker's model neither where it is read before any work."""
    runtime.starts = False
    plan: Any = SimpleNamespace(config=SimpleNamespace(work=SimpleNamespace(device="auto")))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        detector = given_files._read_detector(tiny_yolo(tmp_path / "m.onnx", "boxes"), plan)
        in_floating_point()(image()[None])
    assert len(detector.limitations) == 1
    assert detector.limitations == shipped_detector().limitations


def test_cuda_that_every_worker_must_have_is_refused_without_it(runtime: Runtime) -> None:
    """In 8 bits too."""
    detector = shipped_detector().for_flight([image()], CnnConfig())
    runtime.offered = [CPU]
    sessions.use_device("cuda")
    with pytest.raises(InputError, match="--device cuda"):
        detector.predictor(image()[None])
