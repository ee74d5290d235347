"""Utterances as numbers: embeddings of sentences, and the autoencoder that compresses them.

The supplement takes the 768 numbers that GPT-2 makes of an utterance and compresses them by an
autoencoder (section D). Which embedding is taken is open here: any function from sentences to
vectors. `hashed_words` needs nothing and is the default; `gpt2` needs the package ``transformers``
and the model's weights. A self-model keeps the codes it was trained with in its weights, so that
whoever uses it needs neither.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache

import torch
from torch import Tensor, nn

from mirror_ppl.domains.base import Modality
from mirror_ppl.errors import AssetError

Embedding = Callable[[Sequence[str]], Tensor]
"""From N sentences to vectors ``[N, D]``."""

HASHED = 64
"""Numbers that `hashed_words` makes of a sentence."""
COMPRESSION_STEPS = 500


def hashed_words(sentences: Sequence[str]) -> Tensor:
    """Words and pairs of neighbouring words, each a fixed random vector; of unit length.

    Sentences that share words are alike, and no word has to be known before.

    Args:
        sentences: N of them.

    Returns:
        Vectors ``[N, 64]``.
    """
    vectors = []
    for sentence in sentences:
        words = re.findall(r"[a-z0-9]+", sentence.lower())
        pairs = [f"{first} {second}" for first, second in zip(words, words[1:], strict=False)]
        total = torch.stack([_fixed(part) for part in words + pairs] or [torch.zeros(HASHED)])
        vectors.append(nn.functional.normalize(total.sum(0), dim=0))
    return torch.stack(vectors)


def _fixed(word: str) -> Tensor:
    """Signs ``[64]`` that are the same for a word on every machine."""
    digest = hashlib.blake2b(word.encode(), digest_size=HASHED // 8).digest()
    bits = [byte >> place & 1 for byte in digest for place in range(8)]
    return 2.0 * torch.tensor(bits, dtype=torch.get_default_dtype()) - 1


def gpt2(sentences: Sequence[str]) -> Tensor:
    """Means over tokens of the last hidden states of GPT-2, the supplement's embedding.

    Args:
        sentences: N of them.

    Returns:
        Vectors ``[N, 768]``.

    Raises:
        AssetError: the package ``transformers`` or the weights of GPT-2 are not there.
    """
    try:
        from transformers import (  # pyright: ignore[reportMissingImports]  # an extra
            AutoModel,
            AutoTokenizer,
        )

        tokenizer = AutoTokenizer.from_pretrained("gpt2", local_files_only=True)
        model = AutoModel.from_pretrained("gpt2", local_files_only=True).eval()
    except (ImportError, OSError) as error:
        raise AssetError(
            "GPT-2 is not there: it needs the package transformers and the weights of the model "
            f'"gpt2" in its cache ({error})'
        ) from error
    vectors = []
    with torch.no_grad():
        for sentence in sentences:
            states = model(**tokenizer(sentence, return_tensors="pt")).last_hidden_state
            vectors.append(states[0].mean(0))
    return torch.stack(vectors)


EMBEDDINGS: Mapping[str, Embedding] = {"words": hashed_words, "gpt2": gpt2}
"""Embeddings by the names that commands take; the first is the default."""


class Autoencoder(nn.Module):
    """From an embedding ``[..., D]`` to a code ``[..., C]`` in -1 to 1, and back."""

    def __init__(self, embedding: int, code: int) -> None:
        super().__init__()
        self.encoder = nn.Sequential(nn.Linear(embedding, code), nn.Tanh())
        self.decoder = nn.Linear(code, embedding)

    def forward(self, vectors: Tensor) -> Tensor:
        """The vectors ``[..., D]`` as they come back."""
        return self.decoder(self.encoder(vectors))


def compress(vectors: Tensor, code: int, seed: int = 0) -> Autoencoder:
    """An autoencoder trained on embeddings ``[N, D]``; they count as centred and of unit size.

    Args:
        vectors: what it has to tell apart.
        code: numbers C of the code.
        seed: of its first weights.
    """
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        torch.manual_seed(seed)
        network = Autoencoder(vectors.shape[-1], code)
        optimizer = torch.optim.Adam(network.parameters(), 0.01)
        for _ in range(COMPRESSION_STEPS):
            loss = (network(vectors) - vectors).pow(2).sum(-1).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    return network.requires_grad_(False).eval()


@lru_cache
def utterance_codes(
    modality: Modality, code: int, embedding: Embedding = hashed_words, seed: int = 0
) -> Tensor:
    """Codes ``[K, U, C]`` of the U utterances about each of a modality's K items.

    Args:
        modality: one with utterances.
        code: numbers C of a code.
        embedding: from sentences to vectors.
        seed: of the autoencoder.
    """
    sentences = [sentence for about in modality.utterances for sentence in about]
    vectors = embedding(sentences)
    vectors = vectors - vectors.mean(0)
    vectors = vectors / vectors.pow(2).sum(-1).mean().sqrt().clamp(min=1e-6)
    with torch.no_grad():
        codes = compress(vectors, code, seed).encoder(vectors)
    return codes.view(len(modality.items), -1, code)
