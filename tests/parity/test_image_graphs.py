"""Random graphs on images and sequences through `lads import` and `lads act`, beside ONNX Runtime.

A node of ONNX's conformance tests stands alone; here convolutions, pools, changes of size and what networks put between them follow each
other at random and read each other's results, so that what the compiler fuses, turns, pads and adds in place meets in ways that nobody
wrote down; with weights of 32 bits, and as integers. The seeds are fixed. Skipped where ONNX Runtime or cargo is missing.
"""

import random
import subprocess

import pytest

np = pytest.importorskip("numpy")
onnx = pytest.importorskip("onnx")
ort = pytest.importorskip("onnxruntime")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402
from programs import built  # noqa: E402

# The Makefile's: with another one cargo would build its dependencies once more.
GRAPHS, STEPS, OUTPUTS = 60, 4, 3
TOLERANCE = 1e-4
# Of weights as integers, thrice what these graphs show.
INTEGERS = {"int16": 1e-3, "int8": 2e-2}
HEAD = 'environment = { id = "image-graph", version = "1" }\ncontrol_period_s = 0.02\n'
ELEMENTWISE = {"Relu": {}, "LeakyRelu": {"alpha": 0.2}, "Tanh": {}, "Sigmoid": {}, "Elu": {}, "Softplus": {}}


@pytest.fixture(scope="module")
def lads():
    """-> the path of the command."""
    return built("lads")


class Graph:
    """A graph of `n` images of `channels` that keeps their shape from value to value."""

    def __init__(self, seed):
        self.draw, self.values = random.Random(seed), np.random.default_rng(seed)
        self.nodes, self.constants = [], {}
        self.count, self.channels = self.draw.choice([1, 1, 2, 3]), self.draw.choice([1, 2, 3, 4, 16, 17])
        # Three in ten are sequences.
        self.sides = [self.draw.randint(3, 6) for _ in range(1 if self.draw.random() < 0.3 else 2)]

    def constant(self, value):
        name = f"k{len(self.constants)}"
        self.constants[name] = np.asarray(value)
        return name

    def integers(self, *values):
        return self.constant(np.array(values, np.int64))

    def weights(self, *shape, around=0.0, scale=1.0):
        return self.constant((self.values.uniform(-1, 1, shape) * scale + around).astype(np.float32))

    def per_channel(self, around=0.0):
        return self.weights(self.channels, *[1] * len(self.sides), around=around)

    def add(self, operator, *inputs, **attributes):
        self.nodes.append(helper.make_node(operator, list(inputs), [f"v{len(self.nodes)}"], **attributes))
        return f"v{len(self.nodes) - 1}"

    def convolved(self, x, kernel, inputs=None, **attributes):
        inputs = inputs or self.channels
        weights = self.weights(self.channels, inputs, *kernel, scale=(inputs * np.prod(kernel)) ** -0.5)
        return self.add("Conv", x, weights, self.weights(self.channels), **attributes)

    # Each of the following gives a value of the shape of `x`; `other` is one more that there is.

    def conv(self, x, other):
        kernel = [self.draw.randint(1, 3) for _ in self.sides]
        dilations = [self.draw.randint(1, 2) if size > 1 else 1 for size in kernel]
        missing = [(size - 1) * dilation for size, dilation in zip(kernel, dilations)]
        before = [self.draw.randint(0, most) for most in missing]
        after = [most - part for most, part in zip(missing, before)]
        return self.convolved(x, kernel, pads=before + after, dilations=dilations)

    def groups(self, x, other):
        divisors = [size for size in range(1, self.channels + 1) if self.channels % size == 0]
        # As many groups as channels in half of the cases.
        group = self.draw.choice([self.channels, self.draw.choice(divisors)])
        weights = self.weights(self.channels, self.channels // group, *[3] * len(self.sides), scale=0.5)
        return self.add("Conv", x, weights, pads=[1] * 2 * len(self.sides), group=group)

    def pool(self, x, other):
        operator = self.draw.choice(["MaxPool", "AveragePool"])
        attributes = {"count_include_pad": self.draw.randint(0, 1)} if operator == "AveragePool" else {}
        return self.add(operator, x, kernel_shape=[3] * len(self.sides), pads=[1] * 2 * len(self.sides), **attributes)

    def elementwise(self, x, other):
        operator = self.draw.choice(list(ELEMENTWISE))
        return self.add(operator, x, **ELEMENTWISE[operator])

    def clip(self, x, other):
        low, high = self.draw.choice([0, -0.5]), self.draw.choice([0.5, 6])
        return self.add("Clip", x, *(self.constant(np.float32(bound)) for bound in (low, high)))

    def scaled(self, x, other):
        operator, around = self.draw.choice([("Mul", 2), ("Div", 3), ("Add", 0)])
        return self.add(operator, x, self.per_channel(around))

    def mirrored(self, x, other):
        return self.add("Sub", self.per_channel(), x)

    def sum(self, x, other):
        return self.add("Add", x, other)

    def batch_norm(self, x, other):
        scale, shift, mean = (self.weights(self.channels) for _ in range(3))
        return self.add("BatchNormalization", x, scale, shift, mean, self.weights(self.channels, around=1.2), epsilon=1e-3)

    def padded(self, x, other):
        before, after = ([self.draw.randint(0, 2) for _ in self.sides] for _ in range(2))
        value = [self.constant(np.float32(0.3))] if self.draw.random() < 0.3 else []
        wide = self.add("Pad", x, self.integers(0, 0, *before, 0, 0, *after), *value)
        return self.convolved(wide, [a + b + 1 for a, b in zip(before, after)])

    def sliced(self, x, other):
        axis = self.draw.randrange(len(self.sides))
        part = self.add("Slice", x, self.integers(1), self.integers(99), self.integers(2 + axis))
        pads = [int(place == axis) for place in range(2 * len(self.sides))]
        return self.convolved(part, [1] * len(self.sides), pads=pads)

    def concatenated(self, x, other):
        return self.convolved(self.add("Concat", x, other, axis=1), [1] * len(self.sides), inputs=2 * self.channels)

    def gated(self, x, other):
        return self.add("Mul", x, self.add("Sigmoid", self.add("GlobalAveragePool", x)))

    def resized(self, x, other):
        if len(self.sides) == 1:
            return self.elementwise(x, other)
        mode = self.draw.choice(["nearest", "linear"])
        scales = self.constant(np.array([1, 1, 2, 2], np.float32))
        wide = self.add("Resize", x, "", scales, mode=mode, coordinate_transformation_mode="half_pixel")
        return self.add(self.draw.choice(["MaxPool", "AveragePool"]), wide, kernel_shape=[2, 2], strides=[2, 2])

    def channels_last(self, x, other):
        k = len(self.sides)
        turned, beside = (self.add("Transpose", value, perm=[0, *range(2, 2 + k), 1]) for value in (x, other))
        beside = self.add("Relu", beside) if self.draw.random() < 0.5 else beside
        return self.add("Transpose", self.add("Add", turned, beside), perm=[0, k + 1, *range(1, k + 1)])

    KINDS = (conv, conv, conv, groups, groups, pool, pool, elementwise, clip, scaled, mirrored, sum, sum, batch_norm, padded, sliced, concatenated, gated, resized, channels_last)

    def model(self):
        """-> a model from `images`, one row of all of them, to `y`."""
        shape = [self.count, self.channels, *self.sides]
        length = int(np.prod(shape))
        x = self.add("Reshape", "images", self.integers(*shape))
        if self.draw.random() < 0.4:  # what a normaliser does
            x = self.add("Add", self.add("Mul", x, self.per_channel(2)), self.per_channel())
        values = [x]
        for _ in range(self.draw.randint(3, 9)):
            x = self.draw.choice(self.KINDS)(self, self.draw.choice(values[-3:]), self.draw.choice(values))
            values.append(x)
        row = self.add("Reshape", x, self.integers(1, length))
        self.nodes.append(helper.make_node("MatMul", [row, self.weights(length, OUTPUTS, scale=length**-0.5)], ["y"]))
        read = {name for node in self.nodes for name in node.input}
        tensors = [numpy_helper.from_array(value, name) for name, value in self.constants.items() if name in read]
        edges = [[helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, width])] for name, width in (("images", length), ("y", OUTPUTS))]
        graph = helper.make_graph(self.nodes, "graph", *edges, tensors)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), length


def robot(width):
    """What a person says of such a file."""
    term = f'[[term]]\nname = "images"\ninput = "images"\nwidth = {width}\nunit = "1"\nmin = -2\nmax = 2\n'
    names = ", ".join(f'"a{i}"' for i in range(OUTPUTS))
    return f'{HEAD}{term}[action]\noutput = "y"\nelements = [{names}]\nunit = "1"\nscale = 1\noffset = 0\nmin = -10000\nmax = 10000\ntolerance = {TOLERANCE}\n'


def test_random_graphs_of_images(lads, tmp_path):
    operators, wrong = set(), []
    for seed in range(GRAPHS):
        graph = Graph(seed)
        model, width = graph.model()
        operators |= {node.op_type for node in graph.nodes}
        rows = graph.values.uniform(-1, 1, [STEPS, width]).astype(np.float32)
        session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
        expected = np.concatenate([session.run(None, {"images": row[None]})[0] for row in rows])
        source, bundle, said = (tmp_path / f"{seed}.{ending}" for ending in ("onnx", "lads.onnx", "toml"))
        onnx.save(model, source)
        said.write_text(robot(width))
        imported = subprocess.run([lads, "import", source, "--contract", said, "-o", bundle], capture_output=True, text=True)
        if imported.returncode != 0:
            wrong.append(f"{seed}: {imported.stderr}")
            continue
        text = "".join(",".join(repr(float(value)) for value in row) + "\n" for row in rows)
        policies = {bundle: TOLERANCE}
        for weights, tolerance in INTEGERS.items():
            image = tmp_path / f"{seed}.{weights}.lads"
            how = ["--weights", weights, "--tolerance", str(tolerance * max(1, np.abs(expected).max()))]
            compiled = subprocess.run([lads, "compile", bundle, *how, "-o", image], capture_output=True, text=True)
            if compiled.returncode != 0:
                wrong.append(f"{seed}, {weights}: {compiled.stderr}")
            else:
                policies[image] = tolerance
        for policy, tolerance in policies.items():
            acted = subprocess.run([lads, "act", "--model", policy], input=text, capture_output=True, text=True)
            got = np.array([[float(value) for value in line.split(",")] for line in acted.stdout.splitlines()])
            if got.shape != expected.shape or np.abs(got - expected).max() > tolerance * max(1, np.abs(expected).max()):
                wrong.append(f"{policy.name}: {got.tolist()} instead of {expected.tolist()} {acted.stderr}")
    assert not wrong, "\n".join(wrong)
    # The seeds reach all of them.
    wanted = {"Conv", "MaxPool", "AveragePool", "Resize", "GlobalAveragePool", "BatchNormalization", "Pad", "Slice", "Concat", "Transpose", "Add", "Sub", "Mul", "Div", "Clip", *ELEMENTWISE}
    assert wanted <= operators, wanted - operators
