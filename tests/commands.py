"""Commands in the process of a test."""

from baselines.__main__ import main


def fails(capsys, *arguments):
    """The one line that bad input gets."""
    try:
        code = main(arguments)
    except SystemExit as end:
        code = end.code
    out, err = capsys.readouterr()
    assert code == 2 and out == "" and err.count("\n") == 1 and "Traceback" not in err
    return err
