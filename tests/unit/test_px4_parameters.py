"""Parameters of the endpoint's vehicle travel as PX4's: whole numbers byte by byte in a float."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_bridge.px4_endpoint.dialect import mavlink
from sim_bridge.px4_endpoint.parameters import DEFAULTS, Parameters, decode, encode

INT32: int = mavlink.MAV_PARAM_TYPE_INT32
REAL32: int = mavlink.MAV_PARAM_TYPE_REAL32


def test_a_whole_number_has_its_own_bytes_in_the_float() -> None:
    assert struct.pack("<f", encode(5)) == struct.pack("<i", 5)


@settings(derandomize=True)
@given(st.integers(-1, 2**31 - 1))
def test_a_whole_number_comes_back_as_it_was_sent(value: int) -> None:
    assume_not_a_signalling_nan = not 0x7F800001 <= value <= 0x7FBFFFFF  # its quiet bit is set on the way, as in C
    if assume_not_a_signalling_nan:
        assert decode(encode(value), INT32) == value


def test_a_real_number_is_sent_as_it_is() -> None:
    assert encode(2.5) == 2.5
    assert decode(2.5, REAL32) == 2.5


def test_kinds_are_those_of_px4() -> None:
    parameters = Parameters()
    assert parameters.kind("COM_OBL_RC_ACT") == INT32
    assert parameters.kind("COM_OF_LOSS_T") == REAL32


def test_a_parameter_keeps_its_kind_when_it_is_set() -> None:
    parameters = Parameters()
    parameters.set("COM_OBL_RC_ACT", 5.0)
    assert parameters["COM_OBL_RC_ACT"] == 5
    assert parameters.kind("COM_OBL_RC_ACT") == INT32


def test_an_unknown_parameter_is_refused() -> None:
    parameters = Parameters()
    assert "NO_SUCH" not in parameters
    with pytest.raises(KeyError):
        parameters.set("NO_SUCH", 1.0)


def test_names_fit_into_a_message() -> None:
    assert all(len(name) <= 16 for name in DEFAULTS)
