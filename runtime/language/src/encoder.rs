//! The language encoder: tokens by `tokenizers`, the network by tract.

use std::path::Path;
use std::sync::Arc;

use lads_compiler::Contract;
use lads_compiler::contract::Pooling;
use tokenizers::Tokenizer;
use tract_onnx::prelude::{Framework, InferenceModelExt, Tensor, TypedRunnableModel, tvec};

use crate::error::LanguageError;
use crate::manifest::Manifest;

const MODEL: &str = "encoder.onnx";
const TOKENIZER: &str = "tokenizer.json";

/// Number of characters of a sentence that messages show.
const SHOWN: usize = 60;

/// A language encoder that is loaded for one bundle.
pub struct Encoder {
    tokenizer: Tokenizer,
    network: Arc<TypedRunnableModel>,
    manifest: Manifest,
    /// Index of the hidden layer that the policy reads, from 0; `None` for the mean of the last
    /// over all tokens, as one word.
    layer: Option<usize>,
    /// Largest number of words that the policy takes.
    most: usize,
}

impl Encoder {
    /// Loads the encoder in `folder` (see [`default_folder`](crate::default_folder)), if it is the one that made the bundle's embeddings.
    ///
    /// This takes some seconds: the network is checked against its sha256 and optimised.
    pub fn open(folder: &Path, contract: &Contract) -> Result<Self, LanguageError> {
        let (Some(wanted), Some([most, _])) = (&contract.language, contract.words()) else {
            return Err(LanguageError::NoInstructions);
        };
        let manifest = Manifest::read(folder, wanted)?;
        manifest.check(folder, wanted)?;
        let layer = match wanted.pooling {
            Pooling::Mean => None,
            Pooling::None => {
                let layers = manifest.layers as i64;
                let from_last = if wanted.layer < 0 { layers } else { 0 };
                let layer = i64::from(wanted.layer) + from_last;
                if !(0..layers).contains(&layer) {
                    return Err(LanguageError::Contract {
                        field: "layer",
                        wanted: wanted.layer.to_string(),
                        encoder: wanted.encoder.clone(),
                        has: format!("layers 0 to {}", layers - 1),
                    });
                }
                Some(layer as usize)
            }
        };
        let damaged = |name: &str, problem: String| LanguageError::Damaged {
            path: folder.join(name),
            problem,
        };
        let tokenizer = Tokenizer::from_bytes(manifest.file(folder, TOKENIZER)?)
            .map_err(|error| damaged(TOKENIZER, format!("no tokeniser ({error})")))?;
        let model = manifest.file(folder, MODEL)?;
        let network = tract_onnx::onnx()
            .model_for_read(&mut model.as_slice())
            .and_then(InferenceModelExt::into_optimized)
            .and_then(tract_onnx::prelude::IntoRunnable::into_runnable)
            .map_err(|error| damaged(MODEL, format!("no network that runs ({error})")))?;
        Ok(Self {
            tokenizer,
            network,
            manifest,
            layer,
            most,
        })
    }

    /// Returns the word embeddings `[n, E]` of a sentence, row by row.
    ///
    /// They equal the exporter's to 1e-4: hidden layer `language.layer` without the leading `[CLS]`
    /// and with the trailing `[SEP]`, or the mean of the last layer over all tokens, as the
    /// contract states.
    pub fn words(&self, text: &str) -> Result<Vec<f32>, LanguageError> {
        let failed = |problem: String| LanguageError::Run {
            text: shown(text),
            problem,
        };
        if text.trim().is_empty() {
            return Err(LanguageError::Empty(shown(text)));
        }
        let encoding = self
            .tokenizer
            .encode(text, true)
            .map_err(|error| failed(error.to_string()))?;
        if !encoding.get_special_tokens_mask().contains(&0) {
            return Err(LanguageError::Empty(shown(text)));
        }
        let ids: Vec<i64> = encoding.get_ids().iter().map(|&id| i64::from(id)).collect();
        let too_long = |got, most, who| LanguageError::TooLong {
            text: shown(text),
            got,
            most,
            who,
        };
        let (tokens, most) = (ids.len(), self.manifest.max_tokens);
        if tokens > most {
            return Err(too_long(tokens, most, "the language encoder"));
        }
        if self.layer.is_some() && tokens - 1 > self.most {
            return Err(too_long(tokens - 1, self.most, "the policy"));
        }
        let hidden = self.hidden(&ids).map_err(failed)?;
        Ok(self.heard(&hidden, tokens))
    }

    /// Computes all hidden layers, `[layers, tokens, E]` row by row.
    fn hidden(&self, ids: &[i64]) -> Result<Vec<f32>, String> {
        let run = || {
            let ids = Tensor::from_shape(&[ids.len()], ids)?;
            let outputs = self.network.run(tvec!(ids.into()))?;
            let hidden = outputs.first().map(|hidden| {
                let view = hidden.to_plain_array_view::<f32>()?;
                Ok(view.iter().copied().collect())
            });
            hidden.unwrap_or_else(|| Ok(Vec::new()))
        };
        let hidden: Vec<f32> =
            run().map_err(|error: tract_onnx::prelude::TractError| error.to_string())?;
        let needed = self.manifest.layers * ids.len() * self.manifest.dim;
        if hidden.len() != needed {
            return Err(format!("{} numbers instead of {needed}", hidden.len()));
        }
        Ok(hidden)
    }

    /// Selects the embeddings that the policy reads from the hidden layers of `tokens` tokens.
    fn heard(&self, hidden: &[f32], tokens: usize) -> Vec<f32> {
        let dim = self.manifest.dim;
        let mut layers = hidden.chunks_exact(tokens * dim);
        if let Some(layer) = self.layer {
            let words = layers.nth(layer).and_then(|rows| rows.get(dim..));
            return words.unwrap_or_default().to_vec();
        }
        let mut mean = vec![0.0; dim];
        for row in layers.next_back().unwrap_or_default().chunks_exact(dim) {
            for (sum, x) in mean.iter_mut().zip(row) {
                *sum += x / tokens as f32;
            }
        }
        mean
    }
}

/// Shortens a sentence for messages: one line of bounded length.
fn shown(text: &str) -> String {
    let mut start: String = text.chars().take(SHOWN).collect();
    if start.len() < text.len() {
        start.push('…');
    }
    start.escape_debug().to_string()
}
