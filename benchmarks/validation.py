"""Write docs/validation.md: the published experiments beside every model."""

from pathlib import Path

from analysis.validation import write_page

if __name__ == "__main__":
    print(write_page(Path(__file__).parents[1] / "docs"))
