"""Building an ONNX graph node by node."""

from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

#: The oldest operator set with all operators used, so that old runtimes can read exported agents.
OPSET = 13


class Nodes:
    """Appends nodes and tensors to a graph; each method returns the name of its result.

    Attributes:
        nodes: the nodes, in order.
        tensors: constants, and weights without values.
    """

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.tensors: list[onnx.TensorProto] = []
        self._weights: set[str] = set()

    def layer(self, name: str, features: str, n_in: int, n_out: int) -> str:
        """Append a fully connected layer; its weight has torch's layout, [n_out, n_in]."""
        weight = self.weight(f"{name}.weight", n_out, n_in)
        bias = self.weight(f"{name}.bias", n_out)
        return self.append("Gemm", features, weight, bias, transB=1)

    def column(self, matrix: str, index: int) -> str:
        """Append a selection of one column, [batch, 1]."""
        return self.columns(matrix, index, index + 1)

    def columns(self, matrix: str, first: int, last: int) -> str:
        """Append a selection of columns ``first`` to ``last`` - 1, [batch, last - first]."""
        where = (self.constant(np.array([n])) for n in (first, last, 1))
        return self.append("Slice", matrix, *where)

    def weight(self, name: str, *shape: int) -> str:
        """Append a weight without values, float32; a name that exists refers to the same weight."""
        if name not in self._weights:
            self._weights.add(name)
            tensor = onnx.TensorProto(name=name, dims=shape, data_type=TensorProto.FLOAT)
            self.tensors.append(tensor)
        return name

    def number(self, value: float) -> str:
        """Append a scalar constant, float32."""
        return self.constant(np.array(value, np.float32))

    def constant(self, value: npt.NDArray[np.generic]) -> str:
        """Append a constant, of the dtype of ``value``."""
        name = f"constant.{len(self.tensors)}"
        self.tensors.append(numpy_helper.from_array(value, name))
        return name

    def append(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """Append a node."""
        output = f"{operator.lower()}.{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, inputs, [output], **attributes))
        return output
