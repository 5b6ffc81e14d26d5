//! Lays out the parts of a policy as an image, in the format of `lads_image`.

use lads_image::codec::{Field, Writer};
use lads_image::format::{self, CRC_WORD, Layout, SECTIONS, TABLE_WORD, Tag};
use lads_image::op::Op;
use lads_image::place::Place;
use lads_image::records::{CallRecord, EntryRecord, PortRecord, Source, Text};

use super::writer::Parts;
use super::{Image, Values};

impl Parts {
    /// Returns the image of the parts as they are, sound or not.
    pub fn image(&self) -> Image {
        let mut sections: [Vec<u32>; SECTIONS] = Default::default();
        let [
            contract,
            channels,
            elements,
            instructions,
            strings,
            states,
            entries,
            ports,
            calls,
            clears,
            ops,
            weights,
            golden,
        ] = &mut sections;
        put(contract, &self.contract);
        self.channels
            .iter()
            .for_each(|record| put(channels, record));
        self.elements
            .iter()
            .for_each(|record| put(elements, record));
        self.instructions
            .iter()
            .for_each(|record| put(instructions, record));
        strings.extend(Values::U8(self.strings.clone().into_bytes()).words());
        self.states.iter().for_each(|record| put(states, record));
        let name = Text::default();
        for entry in &self.entries {
            let mut add = |list: &[(Source, Place)]| {
                let first = (ports.len() / PortRecord::WORDS) as u32;
                for &(source, place) in list {
                    put(
                        ports,
                        &PortRecord {
                            name,
                            source,
                            place,
                        },
                    );
                }
                [first, list.len() as u32]
            };
            let ([first_input, inputs_len], [first_output, outputs_len]) =
                (add(&entry.inputs), add(&entry.outputs));
            let record = EntryRecord {
                name,
                first_op: (ops.len() / lads_image::OP_WORDS) as u32,
                ops_len: entry.ops.len() as u32,
                arena_len: entry.arena_len,
                cache: entry.cache,
                tokens: entry.tokens,
                first_input,
                inputs_len,
                first_output,
                outputs_len,
            };
            put(entries, &record);
            ops.extend(entry.ops.iter().flat_map(Op::encode));
        }
        for call in &self.calls {
            let (first_clear, clears_len) = (clears.len() as u32, call.clears.len() as u32);
            put(
                calls,
                &CallRecord {
                    first_clear,
                    clears_len,
                    ..call.record
                },
            );
            clears.extend(&call.clears);
        }
        weights.extend(self.weights.iter().map(|w| w.to_bits()));
        if let Some(episode) = &self.golden {
            put(golden, &episode.record);
            golden.extend(episode.observations.iter().flatten());
            golden.extend(&episode.selected);
            golden.extend(episode.noise.iter().map(|x| x.to_bits()));
            golden.extend(episode.actions.iter().map(|x| x.to_bits()));
        }
        let layout = Layout::new(sections.each_ref().map(|section| section.len() * 4))
            .expect("the image is small");
        let mut words = vec![0; layout.total_bytes() / 4];
        let header = layout.header();
        words[..header.len()].copy_from_slice(&header);
        for (tag, content) in Tag::ALL.iter().zip(&sections) {
            let start = layout.section(*tag).offset / 4;
            words[start..start + content.len()].copy_from_slice(content);
        }
        let mut image = Image(words);
        image.0[CRC_WORD] = format::crc32(image.bytes());
        image
    }
}

fn put<T: Field>(out: &mut Vec<u32>, value: &T) {
    let start = out.len();
    out.resize(start + T::WORDS, 0);
    value.put(&mut Writer::new(&mut out[start..]));
}

/// Returns the words of the header that hold a section's offset and length.
pub fn section_row(tag: Tag) -> [usize; 2] {
    let row = Tag::ALL
        .iter()
        .position(|known| *known == tag)
        .expect("every tag is listed");
    [TABLE_WORD + 3 * row + 1, TABLE_WORD + 3 * row + 2]
}
