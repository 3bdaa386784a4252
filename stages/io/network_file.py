"""Networks that the user has: ONNX files, run by onnxruntime on the CPU. Nothing is downloaded."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import BadInput, UsageError
from pipeline.files import open_plain
from pipeline.text import printable

MOST_BYTES = 2**31 - 1  # an ONNX file cannot have more
Refused = Callable[[str], BadInput]  # the error of a file that holds no such network, by the reason


def open_network(path: Path, option: str, threads: int, refused: Refused) -> Any:
    """The session of onnxruntime.

    option   of the command line, by which the file was given
    Raises UsageError where onnxruntime or the file is missing, what `refused` makes where the file holds no network.
    """
    data = _bytes_of(path, option)
    try:
        import onnxruntime  # an extra
    except ImportError:
        raise UsageError(f"{option} needs the package onnxruntime, which is not installed. Install it: pip install 'efficientnerf[rembg]'") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4  # what fails is an error here
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # a class of its own for each status, of which only Exception is common
        raise refused(printable(error, 200)) from error


def run_network(session: Any, outputs: list[str], inputs: dict[str, np.ndarray], refused: Refused) -> list[np.ndarray]:
    """The outputs of these names."""
    try:
        return [np.asarray(each) for each in session.run(outputs, inputs)]
    except Exception as error:
        raise refused(printable(error, 200)) from error


def in_words(values: Any) -> str:
    """What a network takes or gives."""
    return printable(", ".join(f"{each.name} {each.type} {each.shape}" for each in values), 300)


def _bytes_of(path: Path, option: str) -> bytes:
    try:
        with open(open_plain(path), "rb") as file:
            data = file.read(MOST_BYTES + 1)
    except OSError as error:
        remedy = "Name the ONNX file of a network that you have; none is downloaded."
        raise UsageError(f"{option} {path}: cannot be read ({error.strerror or error}). {remedy}") from None
    if len(data) > MOST_BYTES:
        raise UsageError(f"{option} {path}: of more than {MOST_BYTES:,} bytes, which no ONNX file has.")
    return data
