"""ONNX Runtime's execution providers: which of them work on this machine, and the settings of each."""

from __future__ import annotations

import io
import os
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

from lpn.core.errors import InputError, OutputError
from lpn.core.resources import COMPUTE_ON_CPU, ProviderName

ort.disable_telemetry_events()  # builds for apps of Windows do not read the variable that `lpn` sets

# ONNX Runtime's name of each provider.
EXECUTION_PROVIDERS: dict[ProviderName, str] = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
}
# The largest batch for which TensorRT builds an engine, and the batch size of descriptors on a GPU.
GPU_BATCH = 64
INSTALL = "pip uninstall -y onnxruntime, then pip install 'onnxruntime-gpu[cuda,cudnn]>=1.21'"
_LIBRARIES = {"cuda": "CUDA and cuDNN", "tensorrt": "CUDA, cuDNN, and TensorRT"}


def available() -> list[ProviderName]:
    """Return the providers that the installed ONNX Runtime was built with; their libraries may still be missing."""
    built = ort.get_available_providers()
    return [name for name, provider in EXECUTION_PROVIDERS.items() if provider in built]


def settings(provider: ProviderName, input_size: tuple[int, int], cache: Path) -> list[tuple[str, dict[str, str]]]:
    """Return the providers of a session with their options, in order of preference.

    All compute in float32, not in TF32, whose ten-bit mantissa changes descriptors by more than 1e-4.

    Args:
        input_size: (height, width) of the network input in pixels.
        cache: folder for TensorRT's engines of this model, which ONNX Runtime names without regard to weights; other
            providers leave it alone.
    """
    cpu, cuda, tensorrt = (EXECUTION_PROVIDERS[name] for name in ("cpu", "cuda", "tensorrt"))
    if provider == "cpu":
        return [(cpu, {})]
    # An exhaustive search would stall the first picture of each batch size, and a doubling arena takes memory from others.
    providers = [
        (
            cuda,
            {
                "use_tf32": "0",
                "cudnn_conv_algo_search": "HEURISTIC",
                "arena_extend_strategy": "kSameAsRequested",
            },
        ),
        (cpu, {}),
    ]
    if provider == "tensorrt":
        shape = "images:{}x3x" + "x".join(map(str, input_size))
        options = {
            "trt_engine_cache_enable": "1",
            "trt_timing_cache_enable": "1",
            "trt_engine_cache_path": str(cache),
            "trt_timing_cache_path": str(cache),
            "trt_profile_min_shapes": shape.format(1),
            "trt_profile_opt_shapes": shape.format(GPU_BATCH),
            "trt_profile_max_shapes": shape.format(GPU_BATCH),
        }
        providers.insert(0, (tensorrt, options))
    return providers


def open_on_gpu(path: Path, provider: ProviderName, input_size: tuple[int, int], cache: Path) -> ort.InferenceSession:
    """Open a checked graph on "cuda" or "tensorrt", and compute one blank picture there.

    Args:
        input_size: (height, width) of the network input in pixels.
        cache: see `settings`.

    Raises:
        InputError: if ONNX Runtime lacks the provider, or it does not work.
        OutputError: if the cache of TensorRT's engines cannot be written.
    """
    name = EXECUTION_PROVIDERS[provider]
    built = ort.get_available_providers()
    if name not in built:
        raise InputError(
            f"ONNX Runtime {ort.__version__} has no {name}, but {', '.join(built)}; install the one for GPUs "
            f"({INSTALL}), or {COMPUTE_ON_CPU}."
        )
    if provider == "tensorrt":
        # TensorRT has no other switch for TF32; the driver reads this one when it is loaded.
        os.environ.setdefault("NVIDIA_TF32_OVERRIDE", "0")
        try:
            cache.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"TensorRT's engines cannot be cached in {cache} ({error.strerror}); set LPN_CACHE to a folder that can be "
                "written."
            ) from error
    options = ort.SessionOptions()
    options.log_severity_level = 4
    # Only constants are left to the CPU.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    reason = "it is built in, but was not started"
    try:
        _load_libraries()
        session = _create(path, options, settings(provider, input_size, cache))
        if session.get_providers()[0] == name:
            session.run(["parts"], {"images": np.zeros((1, 3, *input_size), np.float32)})
            return session
    except Exception as error:  # ONNX Runtime's errors have no common base
        reason = str(error).strip().partition("\n")[0][:300]
    raise InputError(
        f"{name} of ONNX Runtime {ort.__version__} does not work here ({reason}); check the driver and the libraries of "
        f"{_LIBRARIES[provider]}, or {COMPUTE_ON_CPU}."
    )


def _load_libraries() -> None:
    """Load the CUDA libraries that pip installs beside ONNX Runtime, where the system does not look for them."""
    if hasattr(ort, "preload_dlls"):  # from 1.21 on
        with redirect_stdout(io.StringIO()):
            ort.preload_dlls()


def _create(path: Path, options: ort.SessionOptions, providers: list[tuple[str, Any]]) -> ort.InferenceSession:
    return ort.InferenceSession(str(path), options, providers=providers, enable_fallback=0)
