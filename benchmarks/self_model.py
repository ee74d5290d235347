"""How good the shipped self-model is, on rounds other than those of its card."""

from mirror_ppl.evaluation.self_model import self_model_quality
from mirror_ppl.models.weights import load_self_model, shipped_weights


def main() -> None:
    """Measure and print, beside the card."""
    self_model, card = load_self_model(shipped_weights("driving"))
    for name, value in self_model_quality(self_model, seed=2).items():
        print(f"{name:40s} {value:8.3f}  card {card['quality'][name]:8.3f}")


if __name__ == "__main__":
    main()
