"""The errors that a user can mend: each says what is wrong, where, and how to mend it."""


class InputError(ValueError):
    """The input is wrong; the command exits with 2.

    `problems` holds one line per thing to mend.
    """

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems
