"""Networks that the user has: ONNX files, run by onnxruntime on the CPU. Nothing is downloaded."""

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import BadInput, UsageError
from pipeline.files import open_plain
from pipeline.text import printable

MOST_BYTES = 2**31 - 1  # an ONNX file cannot have more


class Network:
    """Raises UsageError where onnxruntime or the file is missing, BadInput where the file holds no such network."""

    def __init__(self, path: Path, option: str, threads: int, does: str, expected: str) -> None:
        """
        option    of the command line, by which the file was given
        does      what such a network does, for messages
        expected  what a file of one holds, a sentence
        """
        self._file, self._does, self._expected = f"{option} {path}", does, expected
        try:
            with open(open_plain(path), "rb") as file:
                data = file.read(MOST_BYTES + 1)
        except OSError as error:
            remedy = "Name the ONNX file of a network that you have; none is downloaded."
            raise UsageError(f"{self._file}: cannot be read ({error.strerror or error}). {remedy}") from None
        if len(data) > MOST_BYTES:
            raise UsageError(f"{self._file}: of more than {MOST_BYTES:,} bytes, which no ONNX file has.")
        try:
            import onnxruntime  # an extra
        except ImportError:
            raise UsageError(f"{option} needs the package onnxruntime, which is not installed. Install it: pip install 'efficientnerf[rembg]'") from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 4  # what fails is an error here
        try:
            self._session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # a class of its own for each status, of which only Exception is common
            raise self.refused(printable(error, 200)) from error
        self.inputs, self.outputs = self._session.get_inputs(), self._session.get_outputs()

    def run(self, outputs: list[str], inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        """The outputs of these names."""
        try:
            return [np.asarray(each) for each in self._session.run(outputs, inputs)]
        except Exception as error:
            raise self.refused(printable(error, 200)) from error

    def refused(self, why: str) -> BadInput:
        """The error of a file that holds no such network."""
        return BadInput(f"{self._file}: no network that {self._does} ({why}). {self._expected}")


def in_words(values: Any) -> str:
    """What a network takes or gives."""
    return printable(", ".join(f"{each.name} {each.type} {each.shape}" for each in values), 300)
