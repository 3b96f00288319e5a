"""A small tokenizer of CLIP's kind, and what OpenAI's loop makes of words with its merges."""

from safetensors import numpy as safetensors

START, END = "<|startoftext|>", "<|endoftext|>"
MERGES = ["r e", "re d</w>", "b l", "o c", "bl oc", "k s</w>", "bloc ks</w>", "b lu", "l u", "' s</w>"]


def vocabulary():
    """Ids as OpenAI orders them: bytes, bytes that end a word, merges, start and end."""
    letters = list("!',abcdefghijklmnopqrstuvwxyz")
    names = [*letters, *(f"{letter}</w>" for letter in letters), *(merge.replace(" ", "") for merge in MERGES), START, END]
    return {name: index for index, name in enumerate(names)}


def write(file):
    """Write a `tokenizer.json`, put together as Hugging Face's `CLIPConverter` does; with what must not be heeded."""
    import tokenizers

    normalizers, pre, post, ids = tokenizers.normalizers, tokenizers.pre_tokenizers, tokenizers.processors, vocabulary()
    merges = [tuple(merge.split()) for merge in MERGES]
    made = tokenizers.Tokenizer(tokenizers.models.BPE(ids, merges, end_of_word_suffix="</w>", unk_token=END))
    made.normalizer = normalizers.Sequence([normalizers.NFC(), normalizers.Replace(tokenizers.Regex(r"\s+"), " "), normalizers.Lowercase()])
    words = tokenizers.Regex(r"'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+")
    made.pre_tokenizer = pre.Sequence([pre.Split(words, "removed", invert=True), pre.ByteLevel(add_prefix_space=False)])
    made.add_special_tokens([START, END])
    made.post_processor = post.RobertaProcessing((END, ids[END]), (START, ids[START]), add_prefix_space=False)
    made.enable_truncation(4)
    made.enable_padding(length=9, pad_id=ids[END])
    made.save(str(file))
    return file


def fields(folder, tensors):
    """Write CLIP's files, and give the config's fields that name them."""
    safetensors.save_file(tensors, folder / "clip.safetensors")
    return f"model.clip={folder / 'clip.safetensors'}", f"model.clip_tokenizer={write(folder / 'tokenizer.json')}"


def pieces(word):
    """Merge as OpenAI's `SimpleTokenizer.bpe`: the pair that comes first among the merges, wherever it stands, until there is none."""
    word = [*word[:-1], f"{word[-1]}</w>"]
    while True:
        ranks = [MERGES.index(pair) if (pair := " ".join(word[i : i + 2])) in MERGES else len(MERGES) for i in range(len(word) - 1)]
        if min(ranks, default=len(MERGES)) == len(MERGES):
            return word
        first, second = MERGES[min(ranks)].split()
        merged = []
        for piece in word:
            if piece == second and merged and merged[-1] == first:
                merged[-1] = first + second
            else:
                merged.append(piece)
        word = merged


def ids(words):
    """Give the ids of a sentence of these words."""
    known = vocabulary()
    return [known[piece] for piece in [START, *(piece for word in words for piece in pieces(word)), END]]
