"""How images and speech are read: convolutions, codes, and what masks hide."""

import sys
import types

import pytest
import torch
from torch import nn
from torch.nn.functional import conv2d, conv_transpose2d

from mirror_ppl.domains.modality import Modality
from mirror_ppl.domains.search_rescue import SearchRescue
from mirror_ppl.errors import AssetError, UnknownNameError
from mirror_ppl.models import speech
from mirror_ppl.models.networks import PIXEL_SCALE, Encoder, ImageDecoder
from mirror_ppl.models.readers import ImageReader, SpeechReader, image_patches
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.sizes import Sizes, sizes_of
from mirror_ppl.models.view import View

WORLD = SearchRescue()
VERBAL = next(m for m in WORLD.modalities if m.name == "verbal")
IMAGES = [((3, 3, 3), 3), ((7, 7, 3), 2), ((6, 9, 2), 3)]


def linear_sizes(module):
    return [
        (part.in_features, part.out_features)
        for part in module.modules()
        if isinstance(part, nn.Linear)
    ]


def convolution(reader, image, pixels, stride):
    """What the reader should return, by torch's own convolution."""
    rows, columns, colours = image
    kernel = reader.convolution.weight.view(-1, 3, 3, colours).permute(0, 3, 1, 2)
    maps = conv2d(
        pixels.view(-1, rows, columns, colours).permute(0, 3, 1, 2),
        kernel,
        reader.convolution.bias,
        stride,
    )
    return torch.relu(maps).permute(0, 2, 3, 1).reshape(*pixels.shape[:-1], -1)


# --- images -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("image", "stride"), IMAGES)
def test_images_are_read_by_a_convolution(image, stride):
    reader = ImageReader(2, image, Sizes(stride=stride))
    pixels = torch.randn(5, 2, torch.Size(image).numel())
    torch.testing.assert_close(reader.embed(pixels), convolution(reader, image, pixels, stride))


@pytest.mark.parametrize(("image", "stride"), IMAGES)
def test_images_are_decoded_by_a_deconvolution(image, stride):
    rows, columns, colours = image
    decoder = ImageDecoder(2, image, Sizes(stride=stride))
    z = torch.randn(5, 48)
    channels = decoder.head(decoder.body(z)).view(5, 2, -1, 4)
    height, width = (rows - 3) // stride + 1, (columns - 3) // stride + 1
    maps = channels.view(10, height, width, 4).permute(0, 3, 1, 2)
    kernel = decoder.mean.view(4, 3, 3, colours).permute(0, 3, 1, 2)
    drawn = conv_transpose2d(maps, kernel, stride=stride).permute(0, 2, 3, 1)
    mean, scale = decoder(z)
    torch.testing.assert_close(mean, decoder.same + drawn.reshape(5, 2, -1))
    assert scale.shape == mean.shape
    assert scale.min() >= PIXEL_SCALE


def test_kernels_have_to_cover_an_image():
    places, numbers = image_patches((7, 7, 3), 2)
    assert (places.shape, numbers) == ((9, 27), 27)
    assert places[0].tolist() == [21 * row + 3 * c + k for row in range(3) for c in range(3)
                                  for k in range(3)]  # fmt: skip
    with pytest.raises(ValueError, match="kernels of 3 at stride 3 do not cover 7 x 7"):
        image_patches((7, 7, 3), 3)
    with pytest.raises(ValueError, match="do not cover 2 x 3"):
        image_patches((2, 3, 3), 1)


def test_rescue_s_networks_are_the_supplement_s():
    model = SelfModel(WORLD)
    image, spoken = model.encoder.items["visual"], model.encoder.items["verbal"]
    assert linear_sizes(image.convolution) == [(27, 4)]
    assert linear_sizes(image.body) == [(45, 48), (48, 48), (48, 48), (48, 16)]
    assert linear_sizes(spoken.body) == [(5 * (8 + 1), 16)]
    assert linear_sizes(image.head) == linear_sizes(spoken.head) == [(16, 128)]
    assert linear_sizes(model.encoder.body) == [(128, 128), (128, 128)]
    assert linear_sizes(model.encoder.head) == [(128, 96)]
    assert linear_sizes(model.transition) == [(52, 32), (32, 32), (32, 32), (32, 96)]
    assert linear_sizes(model.decoders["verbal"]) == [(48, 64), (64, 64), (64, 64), (64, 10)]
    assert linear_sizes(model.q_network) == [(48, 200), (200, 200), (200, 200), (200, 1)]
    assert model.decoders["visual"].mean.shape == (4, 27)


# --- what masks hide --------------------------------------------------------------------------


def observed(*batch):
    state = WORLD.initial(batch[0], torch.Generator().manual_seed(0))
    return WORLD.symbols(WORLD.observe(state))


@pytest.mark.parametrize("name", ["visual", "verbal"])
def test_what_is_hidden_counts_for_nothing_and_what_is_seen_does(name):
    torch.manual_seed(0)
    network, values = Encoder(WORLD, sizes_of(WORLD), codes()), observed(6)
    visible = {m.name: torch.rand(6, len(m.items)) < 0.5 for m in WORLD.modalities}
    before = network.combine(network.embed(values), visible)
    other = {key: value.clone() for key, value in values.items()}
    other[name][~visible[name]] += 1.0
    assert torch.equal(network.combine(network.embed(other), visible), before)
    other[name][visible[name]] += 1.0
    assert not torch.equal(network.combine(network.embed(other), visible), before)
    # That something is there counts, too, not only what it is.
    more = {**visible, name: visible[name] | True}
    assert not torch.equal(network.combine(network.embed(values), more), before)


def test_imagined_items_are_read_as_if_they_were_seen():
    network = Encoder(WORLD, sizes_of(WORLD), codes())
    state = WORLD.initial(4, torch.Generator().manual_seed(0))
    observation = WORLD.observe(state)
    imagined = {name: value.flip(0) for name, value in observation.items()}
    masks = {m.name: torch.rand(4, len(m.items)) < 0.5 for m in WORLD.modalities}
    taken = {name: ~mask & (torch.rand(mask.shape) < 0.5) for name, mask in masks.items()}
    symbols, other = WORLD.symbols(observation), WORLD.symbols(imagined)
    overlaid = {
        name: torch.where(mask[..., None], other[name], symbols[name])
        for name, mask in taken.items()
    }
    both = {name: masks[name] | taken[name] for name in masks}
    shown, visible = View(masks, taken, imagined).as_if_seen(observation)
    torch.testing.assert_close(
        network.evidence(WORLD.symbols(shown), visible),
        network.combine(network.embed(overlaid | {"ego": symbols["ego"]}), both),
    )
    assert all(torch.equal(visible[name], both[name]) for name in masks)


def test_views_share_what_items_look_like():
    """One embedded observation under many masks gives what each mask by itself gives."""
    reader = ImageReader(9, (3, 3, 3), sizes_of(WORLD))
    embedded = reader.embed(observed(1)["visual"])
    masks = torch.rand(7, 9) < 0.5
    together = reader.join(embedded, masks)
    for mask, row in zip(masks, together, strict=True):
        torch.testing.assert_close(reader.join(embedded, mask[None])[0], row)


# --- speech -----------------------------------------------------------------------------------


def codes():
    return {"verbal": speech.utterance_codes(VERBAL, 8)}


def test_every_utterance_has_a_code_of_its_own():
    found = codes()["verbal"].flatten(0, 1)
    assert found.shape == (10, 8)
    assert torch.pdist(found).min() > 0.1  # of a range of 2 in each of eight numbers
    assert torch.equal(found, codes()["verbal"].flatten(0, 1))


def test_the_reader_takes_the_code_of_what_is_said():
    table = torch.arange(5 * 2 * 8.0).view(5, 2, 8)
    reader = SpeechReader(table, Sizes())
    which = torch.eye(2)[torch.tensor([1, 0, 0, 1, 0])]
    assert torch.equal(reader.embed(which)[3], table[3, 1])


def test_sentences_that_share_words_are_alike():
    near, other, same = speech.hashed_words(
        ["victim in top-left", "victim in top-right", "Victim  in TOP-LEFT!"]
    )
    away = speech.hashed_words(["left corridor blocked"])[0]
    assert torch.equal(near, same)
    assert near @ other > near @ away
    assert speech.hashed_words(["", "?"]).isfinite().all()
    torch.testing.assert_close(near.norm(), torch.tensor(1.0))


def test_any_embedding_can_be_taken():
    def lengths(sentences):
        return torch.tensor([[float(len(one)), float("not" in one)] for one in sentences])

    model = SelfModel(WORLD, embedding=lengths)
    assert model.encoder.items["verbal"].codes.shape == (5, 2, 8)
    assert not torch.equal(model.encoder.items["verbal"].codes, codes()["verbal"])


def test_the_autoencoder_brings_back_what_it_was_given():
    vectors = speech.hashed_words([one for about in VERBAL.utterances for one in about])
    vectors = vectors - vectors.mean(0)
    network = speech.compress(vectors, 8)
    lost = (network(vectors) - vectors).pow(2).sum() / vectors.pow(2).sum()
    # Ten vectors around their mean have nine dimensions; eight of them hold all but the least.
    assert lost < 0.1


def test_gpt2_says_what_it_needs(monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(AssetError, match="needs the package transformers and the weights"):
        speech.gpt2(["victim in top-right"])


def test_gpt2_is_the_mean_of_its_last_states(monkeypatch):
    """Where the package and the weights are there: a stand-in with a state for each word."""

    def tokenizer(sentence, return_tensors):
        assert return_tensors == "pt"
        return {"words": torch.tensor([[float(len(word)) for word in sentence.split()]])}

    class Network(torch.nn.Module):
        def forward(self, words):
            assert not self.training
            states = torch.stack([words, words**2], -1)
            return types.SimpleNamespace(last_hidden_state=states)

    def stored(found):
        def load(name, local_files_only):
            assert (name, local_files_only) == ("gpt2", True)
            return found

        return types.SimpleNamespace(from_pretrained=load)

    package = types.SimpleNamespace(
        AutoTokenizer=stored(tokenizer), AutoModel=stored(Network().train())
    )
    monkeypatch.setitem(sys.modules, "transformers", package)
    found = speech.gpt2(["to be", "victim"])
    assert torch.equal(found, torch.tensor([[2.0, 4.0], [6.0, 36.0]]))
    assert not found.requires_grad
    codes = speech.utterance_codes(VERBAL, 2, speech.gpt2)
    assert codes.shape == (len(VERBAL.items), len(VERBAL.utterances[0]), 2)
    assert codes.abs().max() <= 1


def test_an_utterance_is_a_string():
    with pytest.raises(TypeError, match="an utterance is a string, not 3"):
        VERBAL.understand(3)


@pytest.mark.parametrize(
    ("said", "item", "which"),
    [("left corridor blocked", 0, 1), ("Victim not in  top-middle", 3, 0)],
)
def test_utterances_are_understood(said, item, which):
    assert VERBAL.understand(said) == (item, which)
    assert WORLD.modalities[1].utterances[item][which] == " ".join(said.lower().split())


def test_utterances_that_nobody_knows_are_refused():
    with pytest.raises(UnknownNameError, match=r'unknown utterance "victim in top-rigt".*perhaps'):
        VERBAL.understand("victim in top-rigt")
    with pytest.raises(UnknownNameError, match="right corridor blocked"):
        VERBAL.understand("go home")


def test_modalities_have_to_fit_together():
    with pytest.raises(ValueError, match="an image's features are its pixels"):
        Modality("visual", ("a",), ("x",), ("1",), (1.0,), 0.1, image=(3, 3, 1))
    with pytest.raises(ValueError, match="each item needs a tuple of its utterances"):
        Modality("verbal", ("a",), ("x",), ("1",), (1.0,), 0.1, utterances=(("a",), ("b",)))


@pytest.mark.parametrize(
    "about",
    [(("free", "blocked", "afar"), ("there", "gone")), (("free", "blocked"), ("Free ", "x"))],
)
def test_utterances_that_could_be_confused_are_refused(about):
    text = "all items need equally many utterances, all different"
    with pytest.raises(ValueError, match=text):
        Modality("verbal", ("a", "b"), ("x",), ("1",), (1.0,), 0.1, utterances=about)
