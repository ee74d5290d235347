"""Short fits by the command, and what they leave in a folder."""

from example_rounds import first_steps

from mirror_ppl.data import asset_path, load_demonstrations

RESULTS = {
    "check.png",
    "identifiability.png",
    "posterior.nc",
    "samples.png",
    "sight.png",
    "summary.json",
}


def two_people():
    """Two people in fog, four short rounds each: three to learn from, one held out."""
    every = load_demonstrations(asset_path("driving_fog_paper.nc"))
    return first_steps(every.select_people([0, 3]).select_rounds(range(4)), 6)


def content(folder):
    return {str(path.relative_to(folder)): path.stat().st_size for path in folder.rglob("*")}


def short_fit(folder, out, *others, steps=4):
    some = "--demos", folder / "some.nc", "--out", folder / out
    return *some, "--guide", "svi", "--steps", steps, "--draws", 10, "--explore", 2, *others


RADIUS = "--human-model", "one-radius"
"""Arguments for a model with few combinations of perceptual implants, which is quick."""
RESULTS_OF_RADIUS = RESULTS - {"sight.png", "samples.png"}
