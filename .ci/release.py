"""Says whether the files agree with a tag: ``python .ci/release.py v0.1.0``. Ends with 1 if not."""

import datetime
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def dated(citation: str) -> tuple[str, str]:
    """Returns the version and the date of a release in the text of a CITATION.cff."""
    version = re.search(r"^version: (.+)$", citation, re.M)
    date = re.search(r"^date-released: (.+)$", citation, re.M)
    if version is None or date is None:
        raise ValueError("CITATION.cff has no version or no date-released")
    return version[1], datetime.date.fromisoformat(date[1]).isoformat()


def disagreements(tag: str, citation: str, changelog: str) -> list[str]:
    """Returns what does not agree with a tag vX.Y.Z, a sentence each."""
    version, date = dated(citation)
    said = []
    if tag != f"v{version}":
        said.append(f"The tag is {tag}, but CITATION.cff has version {version}.")
    if f"\n## {version} ({date})\n" not in changelog:
        said.append(f"CHANGELOG.md has no section '## {version} ({date})'.")
    return said


if __name__ == "__main__":
    texts = [(ROOT / name).read_text(encoding="utf-8") for name in ("CITATION.cff", "CHANGELOG.md")]
    wrong = disagreements(sys.argv[1], *texts)
    print("\n".join(wrong) or f"{sys.argv[1]} agrees with CITATION.cff and CHANGELOG.md.")
    sys.exit(bool(wrong))
