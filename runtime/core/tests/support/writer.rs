//! Writes images: programs and weights are collected, then laid out as `lads_core::image` describes.

use lads_core::codec::{Field, Writer};
use lads_core::image::{
    self, CRC_WORD, ContractRecord, ElementRecord, GoldenRecord, InstructionRecord, Layout,
    PROGRAMS, PortRecord, ProgramRecord, SECTIONS, Section, Text,
};
use lads_core::op::{Op, WeightSpan};

use super::Image;

/// A recorded episode.
#[derive(Clone)]
pub struct Episode {
    pub record: GoldenRecord,
    pub observations: Vec<f32>,
    pub plans: Vec<u32>,
    pub actions: Vec<f32>,
}

/// The parts of an image.
#[derive(Clone)]
pub struct Parts {
    pub contract: ContractRecord,
    pub elements: Vec<ElementRecord>,
    pub instructions: Vec<InstructionRecord>,
    pub strings: String,
    pub programs: [(ProgramRecord, Vec<Op>); PROGRAMS],
    pub weights: Vec<f32>,
    pub golden: Option<Episode>,
}

/// A record without ports and ops.
pub fn empty_program() -> (ProgramRecord, Vec<Op>) {
    let none = [PortRecord::default(); image::PORTS];
    let record = ProgramRecord {
        first_op: 0,
        ops_len: 0,
        arena_len: 0,
        tokens: 0,
        inputs_len: 0,
        inputs: none,
        outputs_len: 0,
        outputs: none,
    };
    (record, Vec::new())
}

/// Appends a text.
pub fn text(strings: &mut String, text: &str) -> Text {
    let offset = strings.len() as u32;
    strings.push_str(text);
    Text {
        offset,
        len: text.len() as u32,
    }
}

/// Appends weights.
pub fn weights(pool: &mut Vec<f32>, values: &[f32]) -> WeightSpan {
    let offset = pool.len() as u32;
    pool.extend(values);
    WeightSpan {
        offset,
        len: values.len() as u32,
    }
}

fn put<T: Field>(out: &mut Vec<u32>, value: &T) {
    let start = out.len();
    out.resize(start + T::WORDS, 0);
    value.put(&mut Writer::new(&mut out[start..]));
}

impl Parts {
    pub fn image(&self) -> Image {
        let mut sections: [Vec<u32>; SECTIONS] = Default::default();
        let [contract, strings, programs, ops, weights, golden] = &mut sections;
        put(contract, &self.contract);
        self.elements
            .iter()
            .for_each(|record| put(contract, record));
        self.instructions
            .iter()
            .for_each(|record| put(contract, record));
        let mut bytes = self.strings.clone().into_bytes();
        bytes.resize(bytes.len().next_multiple_of(4), 0);
        strings.extend(
            bytes
                .chunks(4)
                .map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])),
        );
        for (record, list) in &self.programs {
            let first_op = (ops.len() / lads_core::op::OP_WORDS) as u32;
            put(
                programs,
                &ProgramRecord {
                    first_op,
                    ops_len: list.len() as u32,
                    ..*record
                },
            );
            ops.extend(list.iter().flat_map(Op::encode));
        }
        weights.extend(self.weights.iter().map(|w| w.to_bits()));
        if let Some(episode) = &self.golden {
            put(golden, &episode.record);
            golden.extend(episode.observations.iter().map(|x| x.to_bits()));
            golden.extend(&episode.plans);
            golden.extend(episode.actions.iter().map(|x| x.to_bits()));
        }
        let layout = Layout::new(sections.each_ref().map(|section| section.len() * 4))
            .expect("the image is small");
        let mut words = vec![0; layout.total_bytes() / 4];
        let header = layout.header();
        words[..header.len()].copy_from_slice(&header);
        for (section, content) in Section::ALL.iter().zip(&sections) {
            let start = layout.section(*section).offset / 4;
            words[start..start + content.len()].copy_from_slice(content);
        }
        let mut image = Image(words);
        image.0[CRC_WORD] = image::crc32(image.bytes());
        image
    }
}

/// The word of the header that holds a section's offset.
pub fn section_start(section: Section) -> usize {
    image::SECTION_TABLE_WORD + 2 * section as usize
}
