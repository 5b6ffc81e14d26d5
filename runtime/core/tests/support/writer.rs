//! Describes a policy by its parts, of which `layout` makes an image of version 5.

use lads_core::{Policy, PolicyError, ScheduleError};
use lads_image::codec::{Field, Reader};
use lads_image::op::Op;
use lads_image::place::{Place, WeightSpan};
use lads_image::records::{
    self, Beyond, CallRecord, ChannelRecord, ContractRecord, DType, ElementRecord, Event, Fill,
    GoldenRecord, InstructionRecord, NoiseRule, QuaternionOrder, Repeat, Role, Scope,
    SelectionRule, Source, StateKind, StateRecord, Text, When,
};

use super::{Memory, Random, Values, given, observe};

/// A program and the sources that its ports are bound to.
#[derive(Clone)]
pub struct Entry {
    pub name: String,
    pub ops: Vec<Op>,
    pub arena_len: u32,
    pub cache: u32,
    pub tokens: u32,
    pub inputs: Vec<(Source, Place)>,
    pub outputs: Vec<(Source, Place)>,
}

/// One line of the schedule.
#[derive(Clone)]
pub struct Call {
    pub record: CallRecord,
    pub clears: Vec<u32>,
}

impl Call {
    pub fn on(event: Event, entry: u32) -> Self {
        let record = CallRecord {
            event,
            when: When::Always,
            every: 0,
            otherwise: false,
            entry,
            repeat: Repeat::Times,
            count: 1,
            select: records::NONE,
            first_clear: 0,
            clears_len: 0,
        };
        Self {
            record,
            clears: Vec::new(),
        }
    }

    pub fn step(entry: u32) -> Self {
        Self::on(Event::Step, entry)
    }

    pub fn first(mut self) -> Self {
        self.record.when = When::First;
        self
    }

    pub fn every(mut self, period: u32) -> Self {
        (self.record.when, self.record.every) = (When::Every, period);
        self
    }

    pub fn otherwise(mut self) -> Self {
        self.record.otherwise = true;
        self
    }

    pub fn times(mut self, count: u32) -> Self {
        (self.record.repeat, self.record.count) = (Repeat::Times, count);
        self
    }

    pub fn rows(mut self, ring: u32) -> Self {
        (self.record.repeat, self.record.count) = (Repeat::Rows, ring);
        self
    }

    pub fn select(mut self, scores: u32) -> Self {
        self.record.select = scores;
        self
    }

    pub fn clears(mut self, state: u32) -> Self {
        self.clears.push(state);
        self
    }
}

/// A recorded episode: the values of each observation channel over all steps, in words.
#[derive(Clone)]
pub struct Episode {
    pub record: GoldenRecord,
    pub observations: Vec<Vec<u32>>,
    pub selected: Vec<u32>,
    pub noise: Vec<f32>,
    pub actions: Vec<f32>,
}

/// The parts of an image.
#[derive(Clone)]
pub struct Parts {
    pub contract: ContractRecord,
    pub channels: Vec<ChannelRecord>,
    pub elements: Vec<ElementRecord>,
    pub instructions: Vec<InstructionRecord>,
    pub strings: String,
    pub states: Vec<StateRecord>,
    pub entries: Vec<Entry>,
    pub calls: Vec<Call>,
    pub weights: Vec<f32>,
    pub golden: Option<Episode>,
}

impl Parts {
    /// Makes the parts of a policy without channels, states and calls, whose context is unbounded.
    pub fn new(family: &str) -> Self {
        let none = Text::default();
        let contract = ContractRecord {
            family: none,
            environment_id: none,
            environment_version: none,
            control_period_s: 0.08,
            selection: SelectionRule::Argmax,
            temperature: 1.0,
            selection_seed: 0,
            noise: NoiseRule::Zero,
            noise_seed: 0,
            context_steps: 0,
            beyond: Beyond::Restart,
            encoder: none,
            encoder_sha256: none,
            acceptance: 0.5,
            bundle_sha256: none,
            worst_work: 0,
        };
        let mut parts = Self {
            contract,
            channels: Vec::new(),
            elements: Vec::new(),
            instructions: Vec::new(),
            strings: String::new(),
            states: Vec::new(),
            entries: Vec::new(),
            calls: Vec::new(),
            weights: Vec::new(),
            golden: None,
        };
        parts.contract.family = parts.text(family);
        parts.contract.environment_id = parts.text("test");
        parts.contract.environment_version = parts.text("1");
        parts.contract.bundle_sha256 = parts.text("cafe");
        parts
    }

    pub fn text(&mut self, text: &str) -> Text {
        let offset = self.strings.len() as u32;
        self.strings.push_str(text);
        Text {
            offset,
            len: text.len() as u32,
        }
    }

    pub fn weights(&mut self, values: &[f32]) -> WeightSpan {
        let offset = self.weights.len() as u32;
        self.weights.extend(values);
        WeightSpan {
            offset,
            len: values.len() as u32,
        }
    }

    /// Adds a channel whose values lie within `limits`. Channels of floats with one axis get
    /// elements with names.
    pub fn channel(
        &mut self,
        name: &str,
        role: Role,
        dtype: DType,
        shape: &[u32],
        [min, max]: [f32; 2],
    ) -> u32 {
        let mut dims = [1; 4];
        dims[..shape.len()].copy_from_slice(shape);
        let named = dtype == DType::F32
            && shape.len() == 1
            && matches!(role, Role::Observation | Role::Action);
        let first_element = self.elements.len() as u32;
        for i in 0..if named { shape[0] } else { 0 } {
            let element = ElementRecord {
                name: self.text(&format!("{name}{i}")),
                unit: self.text("rad"),
                scale: 1.0,
                min,
                max,
                ..zeros()
            };
            self.elements.push(element);
        }
        let record = ChannelRecord {
            name: self.text(name),
            role,
            dtype,
            rank: shape.len() as u32,
            dims,
            quaternions: QuaternionOrder::None,
            reference: Text::default(),
            first_element,
            elements_len: self.elements.len() as u32 - first_element,
            min,
            max,
        };
        self.channels.push(record);
        self.channels.len() as u32 - 1
    }

    /// Adds a known instruction, given as whole words.
    pub fn instruction(&mut self, word_dim: usize, words: &[f32]) {
        let number = self.instructions.len();
        let record = InstructionRecord {
            id: self.text(&format!("id{number}")),
            text: self.text(&format!("instruction {number}")),
            words_len: (words.len() / word_dim) as u32,
            words: self.weights(words),
        };
        self.instructions.push(record);
    }

    fn state(
        &mut self,
        name: &str,
        kind: StateKind,
        scope: Scope,
        [width, rows]: [u32; 2],
        fill: Fill,
    ) -> u32 {
        let name = self.text(name);
        self.states.push(StateRecord {
            name,
            kind,
            scope,
            width,
            rows,
            fill,
            offset: 0,
        });
        self.states.len() as u32 - 1
    }

    pub fn plain(&mut self, name: &str, scope: Scope, width: u32) -> u32 {
        self.state(name, StateKind::Plain, scope, [width, 1], Fill::Zero)
    }

    pub fn ring(&mut self, name: &str, width: u32, rows: u32, fill: Fill) -> u32 {
        self.state(name, StateKind::Ring, Scope::Episode, [width, rows], fill)
    }

    /// Adds a KV cache of keys and values of `words` words in all.
    pub fn kv(&mut self, name: &str, words: u32, rows: u32) -> u32 {
        self.state(
            name,
            StateKind::Kv,
            Scope::Episode,
            [words, rows],
            Fill::Zero,
        )
    }

    pub fn entry(&mut self, entry: Entry) -> u32 {
        self.entries.push(entry);
        self.entries.len() as u32 - 1
    }

    /// Places the states consecutively and states the work of the worst step.
    pub fn sealed(mut self) -> Self {
        let cleared: Vec<u32> = self
            .calls
            .iter()
            .flat_map(|call| call.clears.clone())
            .collect();
        let (mut rows, mut bank, mut scratch) = (0, 0, 0);
        for (i, state) in (0_u32..).zip(&mut self.states) {
            let (end, times) = match (state.kind, state.scope) {
                (StateKind::Plain, Scope::Step) => (&mut scratch, 1),
                (StateKind::Plain, _) => (&mut bank, 1),
                (StateKind::Ring, _) => (&mut rows, state.rows + 1),
                (StateKind::Kv, _) => (&mut rows, if cleared.contains(&i) { 2 } else { 1 }),
            };
            state.offset = *end;
            *end += state.width * times;
        }
        self.contract.worst_work = 0;
        if let Some(PolicyError::Schedule(ScheduleError::Work { counted, .. })) =
            self.image().refused()
        {
            self.contract.worst_work = counted;
        }
        self
    }

    /// Adds a recorded episode of `steps` control steps of the last known instruction, made by the
    /// policy itself.
    pub fn with_golden(mut self, steps: usize) -> Self {
        self.golden = None;
        let image = self.image();
        let policy = image.policy();
        let mut memory = Memory::for_policy(&policy);
        let mut controller = memory.controller(&policy);
        let instruction = (self.instructions.len() as u32).checked_sub(1);
        if let Some(id) = instruction {
            controller
                .set_instruction(lads_core::Instruction::Id(id))
                .expect("the instruction is known");
        }
        let noise = policy
            .contract()
            .channels()
            .find(|channel| channel.role() == lads_core::Role::Noise);
        let mut random = Random(5);
        let mut episode = Episode {
            record: GoldenRecord {
                instruction: instruction.unwrap_or(records::NONE),
                steps: steps as u32,
                selects: policy.index_count() > 0,
                noise_len: policy.noise_len() as u32,
                tolerance: 1e-4,
            },
            observations: vec![Vec::new(); policy.contract().observations_len()],
            selected: Vec::new(),
            noise: Vec::new(),
            actions: Vec::new(),
        };
        for _ in 0..steps {
            let mut inputs = observe(&policy, &mut random);
            for ((_, values), all) in inputs.iter().zip(&mut episode.observations) {
                assert!(
                    !matches!(values, Values::U8(bytes) if bytes.len() % 4 != 0),
                    "rows are whole words"
                );
                all.extend(values.words());
            }
            if let Some(channel) = noise {
                let draws = random.vec(policy.noise_len(), 1.0);
                episode.noise.extend(&draws);
                inputs.push((channel.id(), Values::F32(draws)));
            }
            let mut action = vec![0.0; policy.contract().action_len()];
            let report = controller
                .step_with(&given(&inputs), &mut action)
                .expect("the step is sound");
            episode
                .selected
                .extend(report.selected.map(|selected| selected.index));
            episode.actions.extend(action);
        }
        self.golden = Some(episode);
        self
    }

    /// Returns why the image is refused after `edit`, if it is.
    pub fn refused(&self, edit: impl FnOnce(&mut Self)) -> Option<PolicyError> {
        let mut parts = self.clone();
        edit(&mut parts);
        parts.image().refused()
    }

    /// Returns the fault of the schedule after `edit`; another fault is a panic.
    pub fn fault(&self, edit: impl FnOnce(&mut Self)) -> Option<ScheduleError> {
        match self.refused(edit) {
            None => None,
            Some(PolicyError::Schedule(error)) => Some(error),
            Some(other) => panic!("refused for another reason: {other:?}"),
        }
    }

    /// Returns the fault that is left when states and work are corrected after `edit`.
    pub fn sealed_fault(&self, edit: impl FnOnce(&mut Self)) -> Option<ScheduleError> {
        let mut parts = self.clone();
        edit(&mut parts);
        parts.sealed().fault(|_| ())
    }
}

/// Makes a record whose words are all zero.
fn zeros<T: Field>() -> T {
    T::take(&mut Reader::new(&vec![0; T::WORDS])).expect("zeros mean something")
}

/// Counts the work of the worst step, by opening the image without a limit.
pub fn counted_work(parts: &Parts) -> u64 {
    let image = parts.image();
    Policy::new_within(image.bytes(), u64::MAX)
        .expect("the image is sound")
        .contract()
        .worst_work()
}
