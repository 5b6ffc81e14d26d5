//! Reads the policy files: the model, its external data, its inputs and outputs.
//!
//! What can fail: a file is not an ONNX model, or a truncated one; external data is missing, short,
//! larger than stated, or outside the model's folder; names are given twice, nodes form a cycle, a
//! weight is not a number. Each is a problem with its name.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Component, Path, PathBuf};

use bytes::Bytes;
use lads_compiler::onnx::{
    self, DimensionProto, GraphProto, ModelProto, TensorProto, ValueInfoProto, data_type,
};
use lads_compiler::{BundleError, OPSETS, survey};
use prost::Message as _;

use crate::problem::Problems;

/// A policy file.
pub(crate) struct Model {
    /// File name without its ending, which distinguishes values of several files.
    pub stem: String,
    pub path: PathBuf,
    pub proto: ModelProto,
    pub sha256: String,
    /// Files with its external data.
    pub external: Vec<PathBuf>,
    /// Names of weights that could not be read from where they lie.
    lost: Vec<String>,
}

/// An input or output of a graph.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Edge {
    /// Index of the file.
    pub file: usize,
    pub name: String,
    pub elem_type: i32,
    pub dims: Vec<usize>,
}

impl Edge {
    pub fn len(&self) -> usize {
        self.dims.iter().product()
    }
}

/// Largest number of elements of a graph's input or output.
const MAX_LEN: usize = 1 << 20;

impl Model {
    /// Reads a file. Faults inside the file are added to the problems; an error means that the file
    /// cannot be read further.
    pub fn read(path: &Path, problems: &mut Problems) -> Result<Self, BundleError> {
        let named = |source: BundleError| BundleError::File {
            path: path.into(),
            source: Box::new(source),
        };
        let bytes =
            lads_host::input::read(path).map_err(|error| named(BundleError::Read(error)))?;
        let sha256 = lads_compiler::sha256(&bytes);
        let mut proto = onnx::decode(&Bytes::from(bytes)).map_err(named)?;
        let (mut lost, mut external) = (vec![], vec![]);
        if let Some(graph) = &mut proto.graph {
            let folder = path
                .parent()
                .filter(|folder| !folder.as_os_str().is_empty());
            (lost, external) = bring_in(graph, folder.unwrap_or(Path::new(".")), problems);
            check(graph, problems);
        }
        let stem = path.file_stem().unwrap_or_default();
        Ok(Self {
            stem: stem.to_string_lossy().into_owned(),
            path: path.into(),
            proto,
            sha256,
            external,
            lost,
        })
    }

    /// Returns the nodes that the compiler does not support, with the lengths of the axes that are
    /// known so far.
    pub fn operators(
        &self,
        axes: &BTreeMap<String, usize>,
        problems: &mut Problems,
    ) -> Result<(), BundleError> {
        let mut proto = self.proto.clone();
        let inputs = proto.graph.iter_mut().flat_map(|graph| &mut graph.input);
        let shapes =
            inputs.filter_map(|value| value.r#type.as_mut()?.tensor_type.as_mut()?.shape.as_mut());
        for dim in shapes.flat_map(|shape| &mut shape.dim) {
            let name = dim.dim_param.as_deref().unwrap_or("");
            if let Some(&len) = axes.get(name) {
                (dim.dim_value, dim.dim_param) = (Some(len as i64), None);
            }
        }
        let survey = survey(&proto.encode_to_vec())?;
        let known = survey.opset.is_none_or(|opset| OPSETS.contains(&opset));
        if let (Some(opset), false) = (survey.opset, known) {
            let (first, last) = (OPSETS.start(), OPSETS.end());
            problems.add(
                self.path.display(),
                format!(
                    "has ONNX operator set {opset}, {first} to {last} are read; export it with `opset_version=17`, or convert it in Python: `onnx.version_converter.convert_version(model, 17)`"
                ),
            );
        }
        for operator in survey.missing.operators {
            // What is told already: the operator set, and weights that are not there.
            let of_set = operator.node.is_empty() && !known;
            let mut lost = self.lost.iter();
            let of_lost = |name: &String| {
                operator
                    .problem
                    .starts_with(&format!("initializer {name}: "))
            };
            if !of_set && !lost.any(of_lost) {
                problems.add(
                    format!("node `{}`", operator.node),
                    format!("operator {} {}", operator.operator, operator.problem),
                );
            }
        }
        Ok(())
    }

    pub fn graph(&self) -> &GraphProto {
        static NONE: std::sync::OnceLock<GraphProto> = std::sync::OnceLock::new();
        // Always there: reading asked for it.
        self.proto
            .graph
            .as_ref()
            .unwrap_or_else(|| NONE.get_or_init(GraphProto::default))
    }

    /// Returns the metadata of the file.
    pub fn metadata(&self) -> impl Iterator<Item = (&str, &str)> {
        let pairs = self.proto.metadata_props.iter();
        pairs.map(|pair| (pair.key.as_str(), pair.value.as_str()))
    }

    /// Returns the inputs, without those that are weights, and the outputs.
    pub fn edges(
        &self,
        file: usize,
        axes: &BTreeMap<String, usize>,
        problems: &mut Problems,
    ) -> (Vec<Edge>, Vec<Edge>) {
        let graph = self.graph();
        let weights: HashSet<&str> = graph
            .initializer
            .iter()
            .map(|tensor| tensor.name.as_str())
            .collect();
        let mut edge = |value: &ValueInfoProto, input: bool| {
            edge(file, value, axes)
                .map_err(|problem| {
                    let kind = if input { "input" } else { "output" };
                    // An output that is not used may be anything.
                    if input {
                        problems.add(format!("{kind} `{}`", value.name), problem);
                    }
                })
                .ok()
        };
        let inputs = graph
            .input
            .iter()
            .filter(|value| !weights.contains(value.name.as_str()))
            .filter_map(|value| edge(value, true))
            .collect();
        let outputs = graph.output.iter().filter_map(|value| edge(value, false));
        (inputs, outputs.collect())
    }
}

fn edge(
    file: usize,
    value: &ValueInfoProto,
    axes: &BTreeMap<String, usize>,
) -> Result<Edge, String> {
    let tensor = value.r#type.as_ref().and_then(|ty| ty.tensor_type.as_ref());
    let tensor =
        tensor.ok_or("is not a tensor; export the policy with tensors as inputs and outputs")?;
    let shape = tensor
        .shape
        .as_ref()
        .ok_or("has no shape; export the policy with static shapes")?;
    let (mut dims, mut unknown) = (vec![], vec![]);
    for (axis, dim) in shape.dim.iter().enumerate() {
        match length(axis, dim, axes) {
            Ok(len) => dims.push(len),
            Err(problem) => unknown.push(problem),
        }
    }
    if !unknown.is_empty() {
        return Err(unknown.join("; "));
    }
    let len = dims
        .iter()
        .try_fold(1_usize, |len, &dim| len.checked_mul(dim));
    if !len.is_some_and(|len| (1..=MAX_LEN).contains(&len)) {
        return Err(format!(
            "has shape {dims:?}, which has no elements or more than {MAX_LEN}"
        ));
    }
    Ok(Edge {
        file,
        name: value.name.clone(),
        elem_type: tensor.elem_type,
        dims,
    })
}

/// Returns the length of an axis; the first one, if it has a name, is a batch of one.
fn length(
    axis: usize,
    dim: &DimensionProto,
    axes: &BTreeMap<String, usize>,
) -> Result<usize, String> {
    let name = dim.dim_param.as_deref().unwrap_or("");
    if let Some(&len) = axes.get(name) {
        return Ok(len);
    }
    match dim.dim_value {
        Some(len) if len > 0 => Ok(usize::try_from(len).unwrap_or(usize::MAX)),
        Some(len) if dim.dim_param.is_none() && !(len == 0 && axis == 0) => {
            Err(format!("has length {len} along axis {axis}"))
        }
        _ if axis == 0 => Ok(1),
        _ if name.is_empty() => Err(format!(
            "has an axis {axis} of unknown length; export the policy with static shapes"
        )),
        _ => Err(format!(
            "has an axis `{name}` of unknown length: say `axes.{name} = LENGTH`"
        )),
    }
}

/// Puts the elements of external tensors into the model; returns the names of those that cannot be
/// read, and the files that were.
fn bring_in(
    graph: &mut GraphProto,
    folder: &Path,
    problems: &mut Problems,
) -> (Vec<String>, Vec<PathBuf>) {
    let mut lost = vec![];
    let mut files: HashMap<PathBuf, File> = HashMap::new();
    for tensor in &mut graph.initializer {
        if tensor.data_location == 0 && tensor.external_data.is_empty() {
            continue;
        }
        match external(tensor, folder, &mut files) {
            Ok(raw) => {
                tensor.raw_data = raw.into();
                tensor.data_location = 0;
                tensor.external_data.clear();
            }
            Err(problem) => {
                problems.add(format!("weight `{}`", tensor.name), problem);
                lost.push(tensor.name.clone());
            }
        }
    }
    (lost, files.into_keys().collect())
}

fn external(
    tensor: &TensorProto,
    folder: &Path,
    files: &mut HashMap<PathBuf, File>,
) -> Result<Vec<u8>, String> {
    let field = |key: &str| {
        let pair = tensor.external_data.iter().find(|pair| pair.key == key);
        pair.map(|pair| pair.value.as_str())
    };
    let number = |key: &str| {
        field(key)
            .map(str::parse::<u64>)
            .transpose()
            .map_err(|_| format!("states a {key} of external data that is not a number"))
    };
    let location = field("location").ok_or("says no location of its external data")?;
    let relative = Path::new(location);
    let inside = relative
        .components()
        .all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
    if !inside {
        return Err(format!(
            "has external data in `{location}`, outside the model's folder, which is not read; export the weights beside the model"
        ));
    }
    let path = folder.join(relative);
    let (Ok(resolved), Ok(home)) = (path.canonicalize(), folder.canonicalize()) else {
        return Err(format!(
            "has external data in `{location}`, which is missing; put that file beside the model"
        ));
    };
    if !resolved.starts_with(&home) || !resolved.is_file() {
        return Err(format!(
            "has external data in `{location}`, which leads out of the model's folder or is not a file; put the file itself there"
        ));
    }
    let (offset, wanted) = (number("offset")?.unwrap_or(0), expected(tensor)?);
    let length = number("length")?.unwrap_or(wanted);
    if length != wanted {
        return Err(format!(
            "has {length} bytes of external data, its type and shape need {wanted}; export it again"
        ));
    }
    if !files.contains_key(&resolved) {
        let file = File::open(&resolved).map_err(|error| format!("`{location}`: {error}"))?;
        files.insert(resolved.clone(), file);
    }
    let file = files.get_mut(&resolved).ok_or("cannot be read")?;
    let size = file.metadata().map_or(0, |metadata| metadata.len());
    if offset.checked_add(length).is_none_or(|end| end > size) {
        return Err(format!(
            "needs bytes {offset} to {} of `{location}`, which has {size}; copy it again",
            offset.saturating_add(length)
        ));
    }
    let mut raw = vec![0; length as usize];
    file.seek(SeekFrom::Start(offset))
        .and_then(|_| file.read_exact(&mut raw))
        .map_err(|error| format!("`{location}`: {error}"))?;
    Ok(raw)
}

/// Returns the number of bytes of a tensor's elements.
fn expected(tensor: &TensorProto) -> Result<u64, String> {
    let size = match tensor.data_type {
        data_type::FLOAT | data_type::INT32 | 12 => 4,
        data_type::INT64 | 11 | 13 => 8,
        data_type::FLOAT16 | 16 | 4 | 5 => 2,
        data_type::UINT8 | data_type::BOOL | 3 => 1,
        other => {
            return Err(format!(
                "has elements of {}, which no policy has",
                data_type::name(other)
            ));
        }
    };
    let len = tensor.dims.iter().try_fold(size, |len: u64, &dim| {
        len.checked_mul(u64::try_from(dim).ok()?)
    });
    len.filter(|&len| len <= 1 << 30)
        .ok_or_else(|| format!("has shape {:?}, which no policy has", tensor.dims))
}

/// Checks for names given twice, cycles of nodes, and weights that are not numbers.
fn check(graph: &GraphProto, problems: &mut Problems) {
    let weights = graph.initializer.iter().map(|tensor| tensor.name.as_str());
    let mut known: HashSet<&str> = HashSet::new();
    for name in weights {
        if !known.insert(name) {
            problems.add(
                format!("weight `{name}`"),
                "is there twice; export the policy again",
            );
        }
    }
    // Constants of nodes may be infinite, as in masks.
    let weights = graph.initializer.iter();
    let weights = weights.map(|it| (it.name.as_str(), it, false));
    let constants = graph.node.iter().flat_map(|node| {
        let name = node.output.first().map_or("", String::as_str);
        let values = node.attribute.iter().filter_map(|it| it.t.as_ref());
        values.map(move |it| (name, it, true))
    });
    for (name, tensor, may_be_infinite) in weights.chain(constants) {
        if !numbers(tensor, may_be_infinite) {
            problems.add(
                format!("weight `{name}`"),
                "holds a value that is not a finite number; the training has diverged, export an earlier checkpoint",
            );
        }
    }
    let mut inputs = HashSet::new();
    for value in &graph.input {
        if !inputs.insert(value.name.as_str()) {
            problems.add(
                format!("input `{}`", value.name),
                "is there twice; export the policy again",
            );
        }
        known.insert(&value.name);
    }
    let mut later: HashSet<&str> = HashSet::new();
    for name in graph.node.iter().flat_map(|node| &node.output) {
        if !name.is_empty() && (!later.insert(name) || known.contains(name.as_str())) {
            problems.add(
                format!("value `{name}`"),
                "is given twice; export the policy again",
            );
        }
    }
    for node in &graph.node {
        for name in node.input.iter().filter(|name| !name.is_empty()) {
            if !known.contains(name.as_str()) {
                let wrong = if later.contains(name.as_str()) {
                    "is read before it is computed: the nodes are out of order or form a cycle; export the policy again"
                } else {
                    "is computed by no node; export the policy again"
                };
                problems.add(format!("value `{name}`"), wrong);
            }
        }
        known.extend(node.output.iter().map(String::as_str));
    }
    for output in &graph.output {
        if !known.contains(output.name.as_str()) {
            problems.add(
                format!("output `{}`", output.name),
                "is computed by no node; export the policy again",
            );
        }
    }
}

/// Whether a tensor holds numbers, which are finite unless they may not be.
fn numbers(tensor: &TensorProto, may_be_infinite: bool) -> bool {
    let raw = &tensor.raw_data;
    let sound = |x: f64| x.is_finite() || may_be_infinite && !x.is_nan();
    match tensor.data_type {
        data_type::FLOAT => {
            let words = raw.as_chunks::<4>().0.iter();
            let words = words.map(|&word| f32::from_le_bytes(word));
            let mut all = words.chain(tensor.float_data.iter().copied());
            all.all(|x| sound(f64::from(x)))
        }
        data_type::DOUBLE => {
            let words = raw.as_chunks::<8>().0.iter();
            let words = words.map(|&word| f64::from_le_bytes(word));
            words.chain(tensor.double_data.iter().copied()).all(sound)
        }
        data_type::FLOAT16 | data_type::BFLOAT16 => {
            // All ones in the exponent: infinite, or with other bits not a number.
            let (exponent, fraction) = match tensor.data_type {
                data_type::FLOAT16 => (0x7c00, 0x03ff),
                _ => (0x7f80, 0x007f),
            };
            let words = raw.as_chunks::<2>().0.iter();
            let words = words.map(|&word| u16::from_le_bytes(word));
            let mut halves = words.chain(tensor.int32_data.iter().map(|&word| word as u16));
            halves
                .all(|half| half & exponent != exponent || may_be_infinite && half & fraction == 0)
        }
        _ => true,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_number_is_seen_in_every_type() {
        let raw = |data_type, bytes: &[u8]| TensorProto {
            data_type,
            raw_data: bytes.to_vec().into(),
            ..TensorProto::default()
        };
        let halves = |data_type, word: u16| TensorProto {
            data_type,
            int32_data: vec![0, i32::from(word)],
            ..TensorProto::default()
        };
        let float = |x: f32| raw(data_type::FLOAT, &x.to_le_bytes());
        assert!(numbers(&float(1.0), false) && numbers(&float(f32::INFINITY), true));
        assert!(!numbers(&float(f32::INFINITY), false) && !numbers(&float(f32::NAN), true));
        let double = |x: f64| raw(data_type::DOUBLE, &x.to_le_bytes());
        assert!(numbers(&double(1.0), false) && numbers(&double(f64::INFINITY), true));
        assert!(!numbers(&double(f64::INFINITY), false) && !numbers(&double(f64::NAN), true));
        for (kind, infinite, nan) in [
            (data_type::FLOAT16, 0x7c00_u16, 0x7e00),
            (data_type::BFLOAT16, 0x7f80, 0x7fc0),
        ] {
            for of in [halves, |kind, word: u16| TensorProto {
                data_type: kind,
                raw_data: word.to_le_bytes().to_vec().into(),
                ..TensorProto::default()
            }] {
                assert!(numbers(&of(kind, 0x3c00), false) && numbers(&of(kind, infinite), true));
                assert!(!numbers(&of(kind, infinite), false) && !numbers(&of(kind, nan), true));
            }
        }
    }
}
