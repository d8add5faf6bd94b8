"""ONNX Runtime's execution providers, their availability on this machine, and the settings of each."""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.resources import COMPUTE_ON_CPU, PROVIDER_ENDING, ProviderName

ort.disable_telemetry_events()  # builds for Windows apps ignore the variable that `lpn` sets

# The batch size of descriptors on a GPU.
GPU_BATCH = 64
INSTALL = "pip uninstall -y onnxruntime, then pip install 'onnxruntime-gpu[cuda,cudnn]>=1.21'"
# This provider sends graphs to a service, and computes none here.
_REMOTE = "azure"
# An exhaustive search would stall the first picture of each batch size, and a doubling arena takes memory from others. TF32's
# ten-bit mantissa changes descriptors by more than 1e-4.
_CUDA = {"use_tf32": "0", "cudnn_conv_algo_search": "HEURISTIC", "arena_extend_strategy": "kSameAsRequested"}


def available() -> list[ProviderName]:
    """Return the providers of the installed ONNX Runtime's build; their libraries may be missing."""
    built = (name.removesuffix(PROVIDER_ENDING).lower() for name in ort.get_available_providers())
    return sorted(name for name in built if name != _REMOTE)


def open_on_provider(path: Path, provider: ProviderName, input_size: tuple[int, int]) -> ort.InferenceSession:
    """Open a checked graph on another provider than the CPU, and compute one blank picture there.

    Args:
        input_size: (height, width) of the network input in pixels.

    Raises:
        InputError: if ONNX Runtime lacks the provider, or it does not work.
    """
    name, built = _full_name(provider), [one for one in ort.get_available_providers() if _REMOTE not in one.lower()]
    if name not in built:
        raise InputError(
            f"ONNX Runtime {ort.__version__} has no {printable(name)[:60]}, but {', '.join(built)}; install the one that has it "
            f"(for NVIDIA's GPUs {INSTALL}), or {COMPUTE_ON_CPU}."
        )
    options = ort.SessionOptions()
    options.log_severity_level = 4
    # CUDA leaves only constants to the CPU.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    reason = "it is built in, but was not started"
    try:
        _load_libraries()
        preferred = [(name, _CUDA if provider == "cuda" else {}), (f"CPU{PROVIDER_ENDING}", {})]
        session = _create(path, options, preferred)
        if session.get_providers()[0] == name:
            session.run(["parts"], {"images": np.zeros((1, 3, *input_size), np.float32)})
            return session
    except Exception as error:  # ONNX Runtime's errors have no common base
        reason = str(error).strip().partition("\n")[0][:300]
    libraries = "the libraries of CUDA and cuDNN" if provider == "cuda" else "its libraries"
    raise InputError(
        f"{name} of ONNX Runtime {ort.__version__} does not work here ({reason}); check the driver and {libraries}, or "
        f"{COMPUTE_ON_CPU}."
    )


def _full_name(provider: ProviderName) -> str:
    """Return ONNX Runtime's name of a provider; an unknown name is unchanged."""
    known = ort.get_all_providers()
    return next((name for name in known if name.lower() == f"{provider}{PROVIDER_ENDING}".lower()), provider)


def _load_libraries() -> None:
    """Load the CUDA libraries that pip installs beside ONNX Runtime; the system does not search there."""
    if hasattr(ort, "preload_dlls"):  # from 1.21 on
        with redirect_stdout(io.StringIO()):
            ort.preload_dlls()


def _create(path: Path, options: ort.SessionOptions, providers: list[tuple[str, Any]]) -> ort.InferenceSession:
    return ort.InferenceSession(str(path), options, providers=providers, enable_fallback=0)
