//! What a policy expects and promises: sizes, names, units, limits, instructions.
//!
//! A [`Contract`] is a view on the image, checked when the policy is opened; its accessors cannot fail, those with an index
//! give `None` beyond the end.

use core::error::Error;
use core::fmt;

use crate::codec::{Field, Reader};
use crate::image::{
    Beyond, ContractRecord, DecisionRule, ElementRecord, InstructionRecord, PolicyKind,
    QuaternionOrder, Text,
};
use crate::op::WeightSpan;

/// A checked view on the contract of a policy.
#[derive(Debug, Clone, Copy)]
pub struct Contract<'a> {
    record: ContractRecord,
    elements: &'a [u32],
    instructions: &'a [u32],
    strings: &'a str,
    weights: &'a [f32],
}

/// One element of an observation or an action.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Element<'a> {
    /// Name.
    pub name: &'a str,
    /// Unit, `1` for none.
    pub unit: &'a str,
    /// Joint that it belongs to; empty for none.
    pub joint: &'a str,
    /// What the contract allows.
    pub limits: Interval,
}

/// The smallest and the largest value of one element of an observation or an action, in its unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interval {
    /// The smallest value.
    pub min: f32,
    /// The largest value.
    pub max: f32,
}

impl Interval {
    /// The value, or the limit beyond which it lies. What is not a number stays so.
    pub fn clamp(self, value: f32) -> f32 {
        // `f32::clamp` without its panic on limits in the wrong order, which a checked contract does not have; two selections and
        // no branch, so that a control step takes the same instructions whatever the action.
        let raised = if value < self.min { self.min } else { value };
        if raised > self.max { self.max } else { raised }
    }
}

/// One instruction that a policy knows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KnownInstruction<'a> {
    /// Short name.
    pub id: &'a str,
    /// What the person says.
    pub text: &'a str,
    /// Sub-tasks, separated by commas.
    pub sub_tasks: &'a str,
    /// Name of the set that it belongs to in evaluations, such as `seen`.
    pub split: &'a str,
    /// `[n, E]` word embeddings.
    pub words: &'a [f32],
}

/// How the next plan is picked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Decision {
    /// The largest logit, the first of equal ones.
    Argmax,
    /// At random with the softmax of the logits over the temperature. A temperature that is not above zero means argmax.
    Sample {
        /// Divides the logits.
        temperature: f32,
        /// The same seed gives the same plans.
        seed: u64,
    },
}

/// Sizes of the transformer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Network {
    /// Layers.
    pub layers: usize,
    /// Attention heads.
    pub heads: usize,
    /// Elements per head.
    pub head_dim: usize,
}

impl<'a> Contract<'a> {
    /// Checks the contract section against the strings and weights that it points into.
    pub(crate) fn new_checked(
        section: &'a [u32],
        strings: &'a str,
        weights: &'a [f32],
    ) -> Result<Self, ContractError> {
        let (record, rest) = section
            .split_at_checked(ContractRecord::WORDS)
            .ok_or(ContractError::Length)?;
        let fixed = ContractRecord::take(&mut Reader::new(record)).ok_or(ContractError::Record)?;
        let elements_len = (fixed.observation_len as usize)
            .checked_add(fixed.action_len as usize)
            .and_then(|count| count.checked_mul(ElementRecord::WORDS))
            .ok_or(ContractError::Length)?;
        let (elements, instructions) = rest
            .split_at_checked(elements_len)
            .ok_or(ContractError::Length)?;
        let instructions_len =
            (fixed.instruction_count as usize).checked_mul(InstructionRecord::WORDS);
        if instructions_len != Some(instructions.len()) {
            return Err(ContractError::Length);
        }
        let contract = Self {
            record: fixed,
            elements,
            instructions,
            strings,
            weights,
        };
        contract.check()?;
        Ok(contract)
    }

    fn check(&self) -> Result<(), ContractError> {
        let fixed = &self.record;
        let sizes = [
            fixed.observation_len,
            fixed.action_len,
            fixed.horizon,
            fixed.codebook_len,
            fixed.plan_len,
            fixed.words_len,
            fixed.word_dim,
            fixed.context_steps,
        ];
        if sizes.contains(&0) {
            return Err(ContractError::Zero);
        }
        let positive = |x: f32| x.is_finite() && x > 0.0;
        if !positive(fixed.control_period_s) || !positive(fixed.temperature) {
            return Err(ContractError::Number);
        }
        let texts = [
            fixed.environment_id,
            fixed.environment_version,
            fixed.encoder,
            fixed.encoder_sha256,
            fixed.bundle_sha256,
        ];
        self.check_texts(&texts)?;
        for words in self.elements.chunks_exact(ElementRecord::WORDS) {
            let element =
                ElementRecord::take(&mut Reader::new(words)).ok_or(ContractError::Record)?;
            self.check_texts(&[element.name, element.unit, element.joint])?;
            let ordered =
                element.min.is_finite() && element.max.is_finite() && element.min <= element.max;
            if !ordered {
                return Err(ContractError::Limits);
            }
        }
        for words in self.instructions.chunks_exact(InstructionRecord::WORDS) {
            let known =
                InstructionRecord::take(&mut Reader::new(words)).ok_or(ContractError::Record)?;
            self.check_texts(&[known.id, known.text, known.sub_tasks, known.split])?;
            let len = u64::from(known.words_len).saturating_mul(u64::from(fixed.word_dim));
            let fits = (1..=fixed.words_len).contains(&known.words_len)
                && len == u64::from(known.words.len);
            if !fits || self.span(known.words).is_none() {
                return Err(ContractError::Words);
            }
        }
        Ok(())
    }

    fn check_texts(&self, texts: &[Text]) -> Result<(), ContractError> {
        texts
            .iter()
            .try_for_each(|&text| self.find(text).map(|_| ()).ok_or(ContractError::Text))
    }

    fn find(&self, text: Text) -> Option<&'a str> {
        let start = text.offset as usize;
        self.strings
            .get(start..start.checked_add(text.len as usize)?)
    }

    fn text(&self, text: Text) -> &'a str {
        self.find(text).unwrap_or("")
    }

    fn span(&self, span: WeightSpan) -> Option<&'a [f32]> {
        let start = span.offset as usize;
        self.weights
            .get(start..start.checked_add(span.len as usize)?)
    }

    /// What the programs mean.
    pub fn kind(&self) -> PolicyKind {
        self.record.kind
    }

    /// Environment, for example `franka-kitchen`.
    pub fn environment_id(&self) -> &'a str {
        self.text(self.record.environment_id)
    }

    /// The environment's version.
    pub fn environment_version(&self) -> &'a str {
        self.text(self.record.environment_version)
    }

    /// Time from one control step to the next, in seconds.
    pub fn control_period_s(&self) -> f32 {
        self.record.control_period_s
    }

    /// Elements of an observation, `O`.
    pub fn observation_len(&self) -> usize {
        self.record.observation_len as usize
    }

    /// Elements of an action, `A`.
    pub fn action_len(&self) -> usize {
        self.record.action_len as usize
    }

    /// Control steps from one decision to the next, `H`.
    pub fn horizon(&self) -> usize {
        self.record.horizon as usize
    }

    /// Codebook entries, `M`.
    pub fn codebook_len(&self) -> usize {
        self.record.codebook_len as usize
    }

    /// Elements of a plan, `D`.
    pub fn plan_len(&self) -> usize {
        self.record.plan_len as usize
    }

    /// Words of the longest instruction, `L`.
    pub fn words_len(&self) -> usize {
        self.record.words_len as usize
    }

    /// Elements of a word embedding, `E`.
    pub fn word_dim(&self) -> usize {
        self.record.word_dim as usize
    }

    /// Control steps that a context holds.
    pub fn context_steps(&self) -> usize {
        self.record.context_steps as usize
    }

    /// What happens after [`context_steps`](Self::context_steps) control steps.
    pub fn beyond(&self) -> Beyond {
        self.record.beyond
    }

    /// How plans are picked unless the caller says otherwise.
    pub fn decision(&self) -> Decision {
        match self.record.rule {
            DecisionRule::Argmax => Decision::Argmax,
            DecisionRule::Sample => Decision::Sample {
                temperature: self.record.temperature,
                seed: self.record.seed,
            },
        }
    }

    /// Order of the components of the observation's quaternions.
    pub fn quaternion_order(&self) -> QuaternionOrder {
        self.record.quaternion_order
    }

    /// Sizes of the transformer.
    pub fn network(&self) -> Network {
        Network {
            layers: self.record.layers as usize,
            heads: self.record.heads as usize,
            head_dim: self.record.head_dim as usize,
        }
    }

    /// Language encoder that made the word embeddings.
    pub fn encoder(&self) -> &'a str {
        self.text(self.record.encoder)
    }

    /// SHA-256 of the language encoder's weights, hexadecimal.
    pub fn encoder_sha256(&self) -> &'a str {
        self.text(self.record.encoder_sha256)
    }

    /// SHA-256 of the bundle that the image was compiled from, hexadecimal.
    pub fn bundle_sha256(&self) -> &'a str {
        self.text(self.record.bundle_sha256)
    }

    /// Elements of state that the KV cache takes.
    pub(crate) fn cache_len(&self) -> usize {
        self.record.cache_len as usize
    }

    fn element(&self, words: &[u32]) -> Option<Element<'a>> {
        let record = ElementRecord::take(&mut Reader::new(words))?;
        Some(Element {
            name: self.text(record.name),
            unit: self.text(record.unit),
            joint: self.text(record.joint),
            limits: Interval {
                min: record.min,
                max: record.max,
            },
        })
    }

    /// The elements of the observation, then those of the action.
    fn elements(self) -> impl Iterator<Item = Element<'a>> {
        self.elements
            .chunks_exact(ElementRecord::WORDS)
            .filter_map(move |words| self.element(words))
    }

    /// The elements of the observation.
    pub fn observations(&self) -> impl Iterator<Item = Element<'a>> + use<'a> {
        self.elements().take(self.observation_len())
    }

    /// The elements of the action.
    pub fn actions(&self) -> impl Iterator<Item = Element<'a>> + use<'a> {
        self.elements().skip(self.observation_len())
    }

    /// The limits of the observation's elements. Reads no text, so it is what a control step looks at.
    pub fn observation_limits(&self) -> impl Iterator<Item = Interval> + use<'a> {
        limits(self.elements).take(self.observation_len())
    }

    /// The limits of the action's elements, in the same way.
    pub fn action_limits(&self) -> impl Iterator<Item = Interval> + use<'a> {
        limits(self.elements).skip(self.observation_len())
    }

    /// Element `i` of the observation.
    pub fn observation(&self, i: usize) -> Option<Element<'a>> {
        self.observations().nth(i)
    }

    /// Element `i` of the action.
    pub fn action(&self, i: usize) -> Option<Element<'a>> {
        self.actions().nth(i)
    }

    /// How many instructions the policy knows.
    pub fn instruction_count(&self) -> usize {
        self.record.instruction_count as usize
    }

    /// The instructions that the policy knows, in the order of their numbers.
    pub fn instructions(&self) -> impl Iterator<Item = KnownInstruction<'a>> + use<'a> {
        let contract = *self;
        self.instructions
            .chunks_exact(InstructionRecord::WORDS)
            .filter_map(move |words| {
                let record = InstructionRecord::take(&mut Reader::new(words))?;
                Some(KnownInstruction {
                    id: contract.text(record.id),
                    text: contract.text(record.text),
                    sub_tasks: contract.text(record.sub_tasks),
                    split: contract.text(record.split),
                    words: contract.span(record.words)?,
                })
            })
    }

    /// Instruction number `i`.
    pub fn instruction(&self, i: usize) -> Option<KnownInstruction<'a>> {
        self.instructions().nth(i)
    }

    /// Short name of instruction number `i`.
    pub fn instruction_id(&self, i: usize) -> Option<&'a str> {
        self.instruction(i).map(|known| known.id)
    }

    /// Text of instruction number `i`.
    pub fn instruction_text(&self, i: usize) -> Option<&'a str> {
        self.instruction(i).map(|known| known.text)
    }
}

/// The limits in records of elements: their last two words.
fn limits(records: &[u32]) -> impl Iterator<Item = Interval> + use<'_> {
    let (records, _) = records.as_chunks::<{ ElementRecord::WORDS }>();
    records.iter().map(|&[.., min, max]| Interval {
        min: f32::from_bits(min),
        max: f32::from_bits(max),
    })
}

/// Why a contract was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ContractError {
    /// The section is not as long as its tables.
    Length,
    /// A record does not decode.
    Record,
    /// A text lies outside the strings.
    Text,
    /// A size is zero.
    Zero,
    /// The control period or the temperature is not a positive number.
    Number,
    /// The limits of an element are not two ordered numbers.
    Limits,
    /// The words of an instruction lie outside the weights, or there are none or too many.
    Words,
}

impl fmt::Display for ContractError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Self::Length => "the section is not as long as its tables",
            Self::Record => "a record does not decode",
            Self::Text => "a text lies outside the strings",
            Self::Zero => "a size is zero",
            Self::Number => "the control period or the temperature is not a positive number",
            Self::Limits => "the limits of an element are not two ordered numbers",
            Self::Words => {
                "the words of an instruction lie outside the weights, or there are none or too many"
            }
        })
    }
}

impl Error for ContractError {}
