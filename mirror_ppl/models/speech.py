"""Embeddings of utterances, and the autoencoder that compresses them.

The supplement compresses the 768 dimensions of a GPT-2 embedding by an autoencoder (section D).
Here the embedding may be any function from sentences to vectors. `hashed_words` has no requirements
and is the default; `gpt2` needs the package ``transformers`` and the model's weights. A trained
self-model stores its codes in its weights, so using it needs neither.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache

import torch
from torch import Tensor, nn

from mirror_ppl.domains.modality import Modality
from mirror_ppl.errors import AssetError
from mirror_ppl.randomness import forked, seed_everything

Embedding = Callable[[Sequence[str]], Tensor]
"""Maps N sentences to vectors ``[N, D]``."""

HASHED = 64
"""Dimensions of the vectors of `hashed_words`."""
COMPRESSION_STEPS = 500


def hashed_words(sentences: Sequence[str]) -> Tensor:
    """Embed sentences as normalized sums of fixed random vectors of words and word pairs.

    Sentences that share words are similar, and there is no fixed vocabulary.

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
    """Return signs ``[64]`` for a word, the same on every machine."""
    digest = hashlib.blake2b(word.encode(), digest_size=HASHED // 8).digest()
    bits = [byte >> place & 1 for byte in digest for place in range(8)]
    return 2.0 * torch.tensor(bits, dtype=torch.get_default_dtype()) - 1


def gpt2(sentences: Sequence[str]) -> Tensor:
    """Embed sentences as token means of GPT-2's last hidden states, as the supplement does.

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
    """Maps an embedding ``[..., D]`` to a code ``[..., C]`` in -1 to 1, and back."""

    def __init__(self, embedding: int, code: int) -> None:
        super().__init__()
        self.encoder = nn.Sequential(nn.Linear(embedding, code), nn.Tanh())
        self.decoder = nn.Linear(code, embedding)

    def forward(self, vectors: Tensor) -> Tensor:
        """Return the reconstruction ``[..., D]``."""
        return self.decoder(self.encoder(vectors))


def compress(vectors: Tensor, code: int, seed: int = 0) -> Autoencoder:
    """Train an autoencoder on embeddings ``[N, D]``, assumed centred and of unit size.

    Args:
        vectors: the embeddings ``[N, D]``.
        code: dimensions C of the code.
        seed: of its initial weights.
    """
    with forked(), torch.enable_grad():
        seed_everything(seed)
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
    """Return codes ``[K, U, C]`` of the U utterances about each of a modality's K items.

    Args:
        modality: one with utterances.
        code: dimensions C of a code.
        embedding: maps sentences to vectors.
        seed: of the autoencoder.
    """
    sentences = [sentence for about in modality.utterances for sentence in about]
    vectors = embedding(sentences)
    vectors = vectors - vectors.mean(0)
    vectors = vectors / vectors.pow(2).sum(-1).mean().sqrt().clamp(min=1e-6)
    with torch.no_grad():
        codes = compress(vectors, code, seed).encoder(vectors)
    return codes.view(len(modality.items), -1, code)
