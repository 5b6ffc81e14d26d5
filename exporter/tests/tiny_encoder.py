"""Makes a language encoder of a few kilobytes, BERT in everything but size: for tests that have no 90 MB at hand.

`python exporter/tests/tiny_encoder.py FOLDER` writes its export and, beside it, `sentences.json` with what PyTorch makes of some sentences;
`runtime/language/tests/data/tiny-encoder` was made so.
"""

import json
import sys
from pathlib import Path

import torch
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors
from transformers import BertConfig, BertModel, DistilBertConfig, DistilBertModel, PreTrainedTokenizerFast

from lads_exporter import language, language_graph

WORDS = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "open", "close", "the", "draw", "##er", "cup", "##board", "slowly", ",", "!"]
SENTENCES = ("open the drawer", "Close THE cupboard, slowly!", "open")


def bert(**changes):
    sizes = {"hidden_size": 8, "num_hidden_layers": 2, "num_attention_heads": 2, "intermediate_size": 12, "max_position_embeddings": 16}
    return BertModel(BertConfig(vocab_size=len(WORDS), initializer_range=0.5, **sizes, **changes), add_pooling_layer=False)


def distilbert():
    sizes = {"dim": 8, "n_layers": 2, "n_heads": 2, "hidden_dim": 12, "max_position_embeddings": 16}
    return DistilBertModel(DistilBertConfig(vocab_size=len(WORDS), initializer_range=0.5, **sizes))


def save(folder, make=bert):
    """Saves the model and its tokeniser as transformers keeps them."""
    torch.manual_seed(0)
    make().save_pretrained(folder)
    tokenizer = Tokenizer(models.WordPiece({word: i for i, word in enumerate(WORDS)}, unk_token="[UNK]"))
    tokenizer.normalizer = normalizers.BertNormalizer()
    tokenizer.pre_tokenizer = pre_tokenizers.BertPreTokenizer()
    tokenizer.post_processor = processors.BertProcessing(("[SEP]", 3), ("[CLS]", 2))
    # As downloaded ones are: sentences would be cut and filled up.
    tokenizer.enable_truncation(4)
    tokenizer.enable_padding(length=4)
    special = {"unk_token": "[UNK]", "cls_token": "[CLS]", "sep_token": "[SEP]", "pad_token": "[PAD]"}
    PreTrainedTokenizerFast(tokenizer_object=tokenizer, **special).save_pretrained(folder)


def main(target):
    import tempfile

    with tempfile.TemporaryDirectory() as scratch:
        source = Path(scratch) / "tiny-encoder"
        save(source)
        language_graph.write(str(source), target)
        tokenizer, model, _ = language.load(str(source))
        rows = []
        for text in SENTENCES:
            hidden = language.hidden_layers(tokenizer, model, text)
            first, last = hidden[0][0, 1:], hidden[-1][0]
            rows.append({"text": text, "first": first.ravel().tolist(), "last": last[1:].ravel().tolist(), "mean": last.mean(0).tolist()})
        (Path(target) / "sentences.json").write_text(json.dumps(rows) + "\n")


if __name__ == "__main__":
    main(sys.argv[1])
