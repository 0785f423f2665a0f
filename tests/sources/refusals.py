"""How what cannot be used is refused; for tests."""

import pytest

from vehest.data.errors import DataError, VehestError


def refusal(act, kind=DataError):
    """The one printable line of the error in which ``act`` ends.

    Of any kind where ``kind`` is `VehestError`.
    """
    with pytest.raises(VehestError) as error:
        act()
    message = str(error.value)
    assert kind in (type(error.value), VehestError), message
    assert message.isprintable(), message
    return message
