//! Tests of operators on images and sequences against tract, of their fusion, and of refusals.

use super::models::{Small, float, int, ints, text};
use super::operators::{agrees, names, refused};

/// Makes a convolution of an image `[1, c, side, side + 1]` with a kernel
/// `[n, c / groups, rows, cols]`.
fn conv(
    c: usize,
    side: usize,
    kernel: [usize; 4],
    attributes: &[crate::onnx::AttributeProto],
) -> Small {
    Small::new()
        .input("a", &[1, c, side, side + 1])
        .random("w", &kernel)
        .random("bias", &kernel[..1])
        .node("Conv", &["a", "w", "bias"], &["y"], attributes)
}

#[test]
fn convolutions() {
    let plain = conv(3, 6, [5, 3, 3, 3], &[]).output("y", &[1, 5, 4, 5]);
    assert_eq!(names(&agrees(plain)), ["Copy", "Conv", "Copy"]);
    let one = conv(4, 5, [20, 4, 1, 1], &[]).output("y", &[1, 20, 5, 6]);
    agrees(one);
    let padded = [ints("pads", &[1, 0, 2, 3]), ints("strides", &[2, 1])];
    let padded = conv(2, 6, [17, 2, 3, 2], &padded).output("y", &[1, 17, 4, 9]);
    assert_eq!(names(&agrees(padded)), ["Border", "Copy", "Conv", "Copy"]);
    let dilated = [ints("dilations", &[2, 3]), ints("pads", &[2, 3, 2, 3])];
    agrees(conv(3, 7, [4, 3, 3, 3], &dilated).output("y", &[1, 4, 7, 8]));
    for (same, side) in [("SAME_UPPER", 7), ("SAME_LOWER", 8)] {
        let out = |side: usize| side.div_ceil(2);
        let attributes = [text("auto_pad", same), ints("strides", &[2, 2])];
        agrees(
            conv(2, side, [3, 2, 3, 3], &attributes).output("y", &[1, 3, out(side), out(side + 1)]),
        );
    }
    // Zeros around the image, by an operator of their own.
    let around = Small::new()
        .input("a", &[1, 2, 5, 5])
        .random("w", &[4, 2, 3, 3])
        .integers("pads", &[0, 0, 0, 1, 0, 0, 2, 1])
        .node("Pad", &["a", "pads"], &["p"], &[])
        .node("Conv", &["p", "w"], &["y"], &[ints("strides", &[2, 2])])
        .output("y", &[1, 4, 3, 3]);
    assert_eq!(names(&agrees(around)), ["Border", "Copy", "Conv", "Copy"]);
    // Groups, as many as there are channels among them, and with several outputs for each.
    agrees(conv(6, 5, [4, 3, 3, 3], &[int("group", 2)]).output("y", &[1, 4, 3, 4]));
    agrees(conv(6, 5, [12, 1, 3, 3], &[int("group", 6)]).output("y", &[1, 12, 3, 4]));
    let depthwise = [int("group", 18), ints("pads", &[1, 1, 1, 1])];
    let depthwise = conv(18, 5, [18, 1, 3, 3], &depthwise).output("y", &[1, 18, 5, 6]);
    assert_eq!(
        names(&agrees(depthwise)),
        ["Border", "Copy", "Depthwise", "Copy"]
    );
    // Without a bias, several images, and a sequence.
    let images = Small::new()
        .input("a", &[3, 2, 5, 5])
        .random("w", &[4, 2, 2, 2])
        .node("Conv", &["a", "w"], &["y"], &[ints("pads", &[1, 1, 0, 0])]);
    agrees(images.output("y", &[3, 4, 5, 5]));
    let sequence = Small::new()
        .input("a", &[1, 3, 10])
        .random("w", &[5, 3, 4])
        .random("bias", &[5])
        .node(
            "Conv",
            &["a", "w", "bias"],
            &["y"],
            &[ints("strides", &[2]), ints("pads", &[1, 2])],
        );
    agrees(sequence.output("y", &[1, 5, 5]));
}

/// A residual whose elements share their place is added by copy, not overwritten.
#[test]
fn broadcasts_are_added_by_copy() {
    for (images, from) in [(2, [1, 4, 4]), (1, [1, 1, 4]), (2, [1, 1, 4])] {
        let added = Small::new()
            .input("a", &[images, 3, 6])
            .input("b", &[1, 4])
            .random("w", &[4, 3, 3])
            .random("m", &[4, from.iter().product()])
            .integers("shape", &from.map(|len| len as i64))
            .integers("wide", &[images as i64, 4, 4])
            .node("Conv", &["a", "w"], &["c"], &[])
            .node("Transpose", &["c"], &["t"], &[ints("perm", &[0, 2, 1])])
            .node("MatMul", &["b", "m"], &["z"], &[])
            .node("Reshape", &["z", "shape"], &["r"], &[])
            .node("Expand", &["r", "wide"], &["e"], &[])
            .node("Add", &["t", "e"], &["y"], &[])
            .output("y", &[images, 4, 4]);
        agrees(added);
    }
}

#[test]
fn pools() {
    let pool = |operator: &str, attributes: &[crate::onnx::AttributeProto]| {
        Small::new()
            .input("a", &[1, 3, 7, 8])
            .node(operator, &["a"], &["y"], attributes)
    };
    let window = ints("kernel_shape", &[3, 2]);
    for operator in ["MaxPool", "AveragePool"] {
        let plain = pool(operator, &[window.clone(), ints("strides", &[2, 2])]);
        assert_eq!(
            names(&agrees(plain.output("y", &[1, 3, 3, 4]))),
            ["Copy", "Pool", "Copy"]
        );
        let padded = [
            window.clone(),
            ints("pads", &[1, 1, 2, 0]),
            ints("strides", &[2, 3]),
        ];
        agrees(pool(operator, &padded).output("y", &[1, 3, 4, 3]));
    }
    let counted = [
        window,
        ints("pads", &[1, 1, 1, 1]),
        int("count_include_pad", 1),
    ];
    agrees(pool("AveragePool", &counted).output("y", &[1, 3, 7, 9]));
    for operator in ["GlobalAveragePool", "GlobalMaxPool"] {
        agrees(pool(operator, &[]).output("y", &[1, 3, 1, 1]));
    }
}

/// Two convolutions absorb the nodes that image networks put between and after them.
#[test]
fn encoders_become_convolutions_alone() {
    let small = Small::new()
        .input("a", &[1, 9, 8, 3])
        .weights("largest", &[], &[255.0])
        .weights("mean", &[1, 3, 1, 1], &[0.5, 0.4, 0.3])
        .weights("std", &[3, 1, 1], &[0.2, 0.3, 0.4])
        .weights("low", &[], &[0.0])
        .weights("high", &[], &[0.75])
        .random("w", &[6, 3, 4, 4])
        .random("v", &[6, 1, 3, 3])
        .random("u", &[6, 6, 1, 1])
        .random("t", &[6, 6, 3, 3])
        .random("bias", &[6])
        .random("scale", &[6])
        .random("shift", &[6])
        .random("m", &[6])
        .weights("var", &[6], &[0.5, 1.0, 1.5, 2.0, 0.25, 3.0])
        .random("f", &[6 * 4 * 4, 5])
        .integers("flat", &[1, -1])
        .node("Div", &["a", "largest"], &["a0"], &[])
        .node(
            "Transpose",
            &["a0"],
            &["a1"],
            &[ints("perm", &[0, 3, 1, 2])],
        )
        .node("Sub", &["a1", "mean"], &["a2"], &[])
        .node("Div", &["a2", "std"], &["a3"], &[])
        .node(
            "Conv",
            &["a3", "w", "bias"],
            &["b0"],
            &[ints("strides", &[2, 2]), ints("pads", &[1, 1, 1, 1])],
        )
        .node(
            "BatchNormalization",
            &["b0", "scale", "shift", "m", "var"],
            &["b1"],
            &[],
        )
        .node("Clip", &["b1", "low", "high"], &["b2"], &[])
        .node(
            "Conv",
            &["b2", "v"],
            &["c0"],
            &[int("group", 6), ints("pads", &[1, 1, 1, 1])],
        )
        .node(
            "BatchNormalization",
            &["c0", "scale", "shift", "m", "var"],
            &["c1"],
            &[float("epsilon", 1e-3)],
        )
        .node("Relu", &["c1"], &["c2"], &[])
        .node("Conv", &["c2", "u", "bias"], &["d0"], &[])
        .node("Add", &["d0", "b2"], &["d1"], &[])
        .node(
            "Conv",
            &["d1", "t"],
            &["e0"],
            &[ints("pads", &[1, 1, 1, 1])],
        )
        .node("Add", &["d1", "e0"], &["e1"], &[])
        .node("LeakyRelu", &["e1"], &["e2"], &[float("alpha", 0.1)])
        .node("Reshape", &["e2", "flat"], &["e3"], &[])
        .node("MatMul", &["e3", "f"], &["y"], &[])
        .output("y", &[1, 5]);
    let expected = [
        "Border",
        "Copy",
        "Conv",
        "Border",
        "Depthwise",
        "Conv",
        // What the last convolution is added to is what it reads.
        "Copy",
        "Conv",
        "Linear",
    ];
    let program = agrees(small);
    let mut names = names(&program);
    // Where the borders are filled is of no matter.
    names.retain(|name| *name != "Border");
    let mut others = expected.to_vec();
    others.retain(|name| *name != "Border");
    assert_eq!(names, others);
}

/// Convolutions over the steps of a history, as policies of legged robots have them, are images of
/// one row: time is the columns, and nothing has to be moved.
#[test]
fn histories_are_images_of_one_row() {
    let small = Small::new()
        .input("a", &[1, 60])
        .random("w", &[8, 3, 6])
        .random("bias", &[8])
        .random("v", &[5, 8, 3])
        .random("f", &[15, 4])
        .integers("steps", &[1, 20, 3])
        .node("Reshape", &["a", "steps"], &["a0"], &[])
        .node("Transpose", &["a0"], &["a1"], &[ints("perm", &[0, 2, 1])])
        .node(
            "Conv",
            &["a1", "w", "bias"],
            &["b0"],
            &[ints("strides", &[3])],
        )
        .node("Elu", &["b0"], &["b1"], &[])
        .node("Conv", &["b1", "v"], &["c0"], &[])
        .node("Elu", &["c0"], &["c1"], &[float("alpha", 0.5)])
        .node("Flatten", &["c1"], &["c2"], &[])
        .node("MatMul", &["c2", "f"], &["y"], &[])
        .output("y", &[1, 4]);
    assert_eq!(names(&agrees(small)), ["Conv", "Conv", "Linear"]);
    // Depthwise, with gaps and padding, and what is taken of all steps.
    let small = Small::new()
        .input("a", &[1, 4, 12])
        .random("w", &[4, 1, 3])
        .node(
            "Conv",
            &["a", "w"],
            &["b0"],
            &[
                int("group", 4),
                ints("dilations", &[2]),
                ints("pads", &[4, 0]),
            ],
        )
        .node("Tanh", &["b0"], &["b1"], &[])
        .node(
            "AveragePool",
            &["b1"],
            &["b2"],
            &[ints("kernel_shape", &[3]), ints("strides", &[3])],
        )
        .node("GlobalMaxPool", &["b2"], &["y"], &[])
        .output("y", &[1, 4, 1]);
    agrees(small);
}

#[test]
fn what_somebody_else_reads_stays() {
    let small = Small::new()
        .input("a", &[1, 2, 4, 4])
        .random("w", &[2, 2, 3, 3])
        .node("Conv", &["a", "w"], &["z"], &[ints("pads", &[1, 1, 1, 1])])
        .node("Relu", &["z"], &["p"], &[])
        .node("Add", &["p", "a"], &["y"], &[])
        .output("y", &[1, 2, 4, 4])
        .output("z", &[1, 2, 4, 4]);
    agrees(small);
    // The mean over rows and columns by another name, and a product with it.
    let gate = Small::new()
        .input("a", &[1, 4, 5, 3])
        .random("w", &[4, 4, 1, 1])
        .integers("sides", &[2, 3])
        .node("Conv", &["a", "w"], &["b"], &[])
        .node("ReduceMean", &["b", "sides"], &["m"], &[int("keepdims", 1)])
        .node("Sigmoid", &["m"], &["s"], &[])
        .node("Mul", &["b", "s"], &["c"], &[])
        .node("MaxPool", &["c"], &["y"], &[ints("kernel_shape", &[2, 2])])
        .output("y", &[1, 4, 4, 2]);
    agrees(gate);
}

#[test]
fn images_that_are_refused() {
    let image = || Small::new().input("a", &[1, 4, 5, 5]);
    let w = |small: Small| small.random("w", &[2, 4, 3, 3]);
    let y = |small: Small| small.output("y", &[1, 2, 3, 3]);
    let with = |attribute| y(w(image()).node("Conv", &["a", "w"], &["y"], &[attribute]));
    refused(
        &with(int("group", 3)),
        &[
            "Conv",
            "[2, 4, 3, 3]",
            "3 groups for 4 channels",
            "correct the layer's group",
        ],
    );
    refused(
        &with(ints("strides", &[0, 1])),
        &[
            "strides [0, 1]",
            "2 numbers from 1",
            "give the layer such strides",
        ],
    );
    refused(&with(ints("pads", &[1, 1])), &["pads [1, 1]", "4 numbers"]);
    refused(
        &with(ints("dilations", &[3, 3])),
        &[
            "a window of 7 over 5 elements",
            "smaller dilations (3)",
            "a larger input",
        ],
    );
    refused(&with(text("auto_pad", "SAME")), &["auto_pad = SAME"]);
    refused(
        &with(ints("kernel_shape", &[2, 3])),
        &["kernel_shape [2, 3]", "leave kernel_shape out"],
    );
    let empty = image().weights("w", &[2, 4, 0, 3], &[]);
    refused(
        &y(empty.node("Conv", &["a", "w"], &["y"], &[])),
        &["Conv", "[2, 4, 0, 3]"],
    );
    // What a few bytes of a file can ask for.
    let many =
        Small::new()
            .input("a", &[1 << 20, 4, 5, 5])
            .node("GlobalMaxPool", &["a"], &["y"], &[]);
    refused(&many.output("y", &[1 << 20, 4, 1, 1]), &["N up to 4096"]);
    let wide = [
        ints("strides", &[60_000, 60_000]),
        ints("pads", &[60_000, 60_000, 60_000, 60_000]),
    ];
    refused(
        &w(image())
            .node("Conv", &["a", "w"], &["y"], &wide)
            .output("y", &[1, 2, 3, 3]),
        &["its border", "120003"],
    );
    let volume = Small::new()
        .input("a", &[1, 4, 5, 5, 5])
        .random("w", &[2, 4, 3, 3, 3])
        .node("Conv", &["a", "w"], &["y"], &[]);
    refused(
        &volume.output("y", &[1, 2, 3, 3, 3]),
        &["[N, C, rows, columns]", "[1, 4, 5, 5, 5]"],
    );
    let given = image()
        .input("w", &[2, 4, 3, 3])
        .node("Conv", &["a", "w"], &["y"], &[]);
    refused(&y(given), &["Conv", "constant weights"]);
    let pool = image().node("MaxPool", &["a"], &["y"], &[]);
    refused(&y(pool), &["MaxPool", "kernel_shape"]);
    let resize = |attributes: &[crate::onnx::AttributeProto]| {
        let small = image().weights("by", &[4], &[1.0, 1.0, 2.0, 2.0]);
        small
            .node("Resize", &["a", "", "by"], &["y"], attributes)
            .output("y", &[1, 4, 10, 10])
    };
    refused(
        &resize(&[text("mode", "cubic")]),
        &["Resize", "mode = cubic"],
    );
    refused(
        &resize(&[text("coordinate_transformation_mode", "tf_crop_and_resize")]),
        &["tf_crop_and_resize"],
    );
    let channels = image().weights("by", &[4], &[1.0, 2.0, 2.0, 2.0]).node(
        "Resize",
        &["a", "", "by"],
        &["y"],
        &[],
    );
    refused(
        &channels.output("y", &[1, 8, 10, 10]),
        &["rows and columns only"],
    );
}
