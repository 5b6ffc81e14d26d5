//! Channels of a contract: the inputs and outputs of a policy.

use serde::Deserialize;

use super::Faults;
use super::check::distinct;

/// Largest number of elements of a channel.
const MAX_CHANNEL_LEN: usize = 1 << 26;

/// Purpose of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Given by the caller in every control step.
    Observation,
    /// Written by every control step.
    Action,
    /// Word embeddings, `[words, elements]`.
    Instruction,
    /// Random numbers; the shape is that of one draw.
    Noise,
    /// A piece of a demonstration, to be encoded.
    Demonstration,
}

/// Type of a channel's elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DType {
    /// Elements of 32-bit floats.
    F32,
    /// Elements of bytes, such as the pixels of a camera.
    U8,
    /// Elements of signed 32-bit integers.
    I32,
}

/// One channel: an input or output of the policy.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Channel {
    /// Name of the channel.
    pub name: String,
    /// Purpose of the channel.
    pub role: Role,
    /// Type of the channel's elements.
    pub dtype: DType,
    /// Lengths of the channel's axes, one to four.
    pub shape: Vec<usize>,
    /// Order of the components of the channel's quaternions.
    #[serde(default)]
    pub quaternion_order: QuaternionOrder,
    /// Description of the reference that the values are relative to.
    #[serde(default)]
    pub reference: String,
    /// Elements of the channel; none for images, instructions and the like.
    #[serde(default)]
    pub elements: Vec<Element>,
    /// Smallest value of any element, for a channel without elements of its own.
    #[serde(default)]
    pub min: Option<f32>,
    /// Largest value of any element, for a channel without elements of its own.
    #[serde(default)]
    pub max: Option<f32>,
    /// How a simulator draws the frames of a camera, in the simulator's own terms; never part of an image.
    #[serde(default)]
    pub rendering: Option<serde_json::Value>,
}

impl Channel {
    /// Returns the number of elements of the channel.
    #[expect(
        clippy::len_without_is_empty,
        reason = "a checked channel has an element at least"
    )]
    pub fn len(&self) -> usize {
        let product = |len: usize, &dim| len.saturating_mul(dim);
        self.shape.iter().fold(1, product)
    }

    /// Returns the limits of a channel without elements of its own: those stated, or the whole
    /// range of its type.
    pub fn limits(&self) -> (f32, f32) {
        let (min, max) = match self.dtype {
            DType::F32 => (f32::MIN, f32::MAX),
            DType::U8 => (0.0, 255.0),
            DType::I32 => (i32::MIN as f32, i32::MAX as f32),
        };
        (self.min.unwrap_or(min), self.max.unwrap_or(max))
    }

    pub(super) fn check(&self, at: &str, faults: &mut Faults) {
        let len = self.shape.iter().try_fold(1_usize, |len, &dim| {
            len.checked_mul(dim)
                .filter(|&len| (1..=MAX_CHANNEL_LEN).contains(&len))
        });
        let [shape, elements, min_field, max_field, dtype, role] =
            ["shape", "elements", "min", "max", "dtype", "role"]
                .map(|field| format!("{at}.{field}"));
        if faults.sound(&[&shape]) && (!(1..=4).contains(&self.shape.len()) || len.is_none()) {
            faults.add(
                &shape,
                format!(
                    "is {:?}{}, it must have one to four axes and 1 to {MAX_CHANNEL_LEN} elements",
                    self.shape.iter().take(4).collect::<Vec<_>>(),
                    if self.shape.len() > 4 {
                        " and so on"
                    } else {
                        ""
                    }
                ),
            );
        } else if faults.sound(&[&shape, &dtype, &role]) && faults.counted(&elements) {
            self.count_elements(&elements, faults);
        }
        for (i, element) in self.elements.iter().enumerate() {
            element.check(&format!("{elements}[{i}]"), faults);
        }
        let names = self.elements.iter().map(|element| element.name.as_str());
        distinct(&elements, "name", names, faults);
        let (min, max) = self.limits();
        if faults.sound(&[&min_field, &max_field, &dtype])
            && !(min.is_finite() && max.is_finite() && min < max)
        {
            faults.add(
                &min_field,
                format!("is {min} and `max` {max}, which is no range"),
            );
        }
    }

    /// Checks the number of elements of a channel whose shape is sound.
    fn count_elements(&self, at: &str, faults: &mut Faults) {
        let described = matches!(self.role, Role::Observation | Role::Action);
        let vector = self.dtype == DType::F32 && self.shape.len() == 1;
        if described && vector && self.elements.len() != self.len() {
            faults.add(
                at,
                format!(
                    "has {} elements, its shape {:?} says {}",
                    self.elements.len(),
                    self.shape,
                    self.len()
                ),
            );
        } else if !self.elements.is_empty() && (!vector || self.elements.len() != self.len()) {
            faults.add(
                at,
                "must be empty: only vectors of f32 have elements, one for each of their length",
            );
        }
    }
}

/// One element of a channel.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Element {
    /// Name of the element.
    pub name: String,
    /// Unit of the element; `1` for a dimensionless one.
    pub unit: String,
    /// Smallest value that the contract allows.
    pub min: f32,
    /// Largest value that the contract allows.
    pub max: f32,
    /// Joint that the element belongs to.
    #[serde(default)]
    pub joint: Option<String>,
    /// Quantity of the joint: position, velocity, effort.
    #[serde(default)]
    pub interface: Option<String>,
    /// Physical value of one unit of the element: physical = reference + offset + scale * value.
    #[serde(default = "one")]
    pub scale: f32,
    /// Physical value for an element of zero, without the channel's reference.
    #[serde(default)]
    pub offset: f32,
    /// Unit of the physical value.
    #[serde(default)]
    pub physical_unit: Option<String>,
    /// Proportional gain of the joint's own controller with which the policy was trained, per unit of the action.
    #[serde(default)]
    pub stiffness: Option<f32>,
    /// Derivative gain of the joint's own controller with which the policy was trained.
    #[serde(default)]
    pub damping: Option<f32>,
}

fn one() -> f32 {
    1.0
}

impl Element {
    fn check(&self, at: &str, faults: &mut Faults) {
        let Self {
            name,
            min,
            max,
            scale,
            offset,
            ..
        } = self;
        let sound = |fields: [&str; 2], faults: &Faults| {
            let [first, second] = fields.map(|field| format!("{at}.{field}"));
            faults.sound(&[&first, &second])
        };
        if sound(["scale", "offset"], faults) && !(scale.is_finite() && offset.is_finite()) {
            faults.add(
                at,
                format!("({name}) has scale {scale} and offset {offset}, which are not numbers"),
            );
        }
        if sound(["min", "max"], faults) && !(min.is_finite() && max.is_finite() && min < max) {
            faults.add(
                at,
                format!("({name}) has limits {min} to {max}, which is no range"),
            );
        }
    }
}

/// Order of the components of quaternions in a channel.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum QuaternionOrder {
    /// The channel has no quaternions.
    #[default]
    None,
    /// Quaternions with the scalar first.
    Wxyz,
    /// Quaternions with the scalar last.
    Xyzw,
}
