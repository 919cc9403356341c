"""How to cite the program; CITATION.cff of the repository says the same."""

TITLE = "mjx_reinforce: REINFORCE on MuJoCo, a thousand seeds in one program"
AUTHORS = "The mjx_reinforce authors"
YEAR = 2026


def bibtex(version: str) -> str:
    """Returns an entry for a bibliography, of BibTeX's type misc, which every style knows."""
    return (
        (
            f"@misc{{mjx_reinforce, author = {{{{{AUTHORS}}}}}, title = {{{{{TITLE}}}}}, "
            f"year = {{{YEAR}}}, note = {{Version {version}}}}}"
        )
        .replace("mjx_reinforce:", r"mjx\_reinforce:")
        .replace("{{The mjx_", r"{{The mjx\_")
    )
