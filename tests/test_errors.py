"""The exceptions can be caught as this package's own or as the standard classes."""

from phsi_opt.errors import DataError, PhsiOptError, did_you_mean


def test_data_errors_are_value_errors_and_errors_of_this_package() -> None:
    assert issubclass(DataError, ValueError) and issubclass(DataError, PhsiOptError)


def test_suggestions_ignore_case_and_say_nothing_when_nothing_is_close() -> None:
    assert (
        did_you_mean("Positon", ["velocity", "POSITION"]) == " Did you mean 'POSITION'?"
    )
    assert did_you_mean("xyz", ["velocity"]) == ""
    assert did_you_mean(3, []) == ""
