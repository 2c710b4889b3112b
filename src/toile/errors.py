"""The one exception that reaches the user as a plain message instead of a traceback."""


class InputError(ValueError):
    """Bad input: says what is wrong, where, what was expected and what was got.

    The command line prints it as one message and exits with status 2.
    """

    def __init__(self, what: str, *, where: str, expected: str, got: str) -> None:
        self.what, self.where, self.expected, self.got = what, where, expected, got
        super().__init__(f"{what}\n  where:    {where}\n  expected: {expected}\n  got:      {got}")

    def __reduce__(self) -> tuple[object, ...]:
        """It goes from process to process, where it is made from its one argument otherwise."""
        return _again, (type(self), self.what, self.where, self.expected, self.got), self.__dict__


def _again(kind: type[InputError], what: str, where: str, expected: str, got: str) -> InputError:
    return kind(what, where=where, expected=expected, got=got)
