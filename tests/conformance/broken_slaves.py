"""Slaves that break one rule each: a conforming node behind a proxy.

The item that must find a slave is the argument of its decorator. The node-ID is 1.
"""

from collections.abc import Callable
from typing import NamedTuple

from simulated_slave import Proxy, Rule, pass_on

from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.status import NmtState

_NMT = 0x000
_SYNC = 0x080
_EMCY = 0x081
_TPDO = 0x181
_SDO_RESPONSE = 0x581
_SDO_REQUEST = 0x601
_HEARTBEAT = 0x701
_LSS_RESPONSE = 0x7E4
_LSS_REQUEST = 0x7E5


class BrokenSlave(NamedTuple):
    """A slave, and the item that must find it."""

    name: str
    item: str
    from_master: Rule
    from_node: Rule


BROKEN: list[BrokenSlave] = []


def _request(item: str, can_id: int, begin: str = "") -> Callable[[Rule], Rule]:
    """Add a slave that treats frames of the master with this id and begin as other ones."""

    def add(rule: Rule) -> Rule:
        BROKEN.append(BrokenSlave(rule.__name__, item, _only(rule, can_id, begin), pass_on))
        return rule

    return add


def _response(item: str, can_id: int, begin: str = "", end: str = "") -> Callable[[Rule], Rule]:
    """Add a slave that sends something else instead of frames with this id, begin and end."""

    def add(rule: Rule) -> Rule:
        BROKEN.append(BrokenSlave(rule.__name__, item, pass_on, _only(rule, can_id, begin, end)))
        return rule

    return add


def _only(rule: Rule, can_id: int, begin: str, end: str = "") -> Rule:
    """Return a rule for frames with this id whose data begin and end with these bytes."""

    def apply(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
        data = frame.data
        is_like = data.startswith(bytes.fromhex(begin)) and data.endswith(bytes.fromhex(end))
        if frame.can_id == can_id and is_like:
            return rule(frame, proxy)
        return [frame]

    return apply


def _with(frame: CanFrame, at: int, data: str) -> list[CanFrame]:
    """Return the frame with other bytes at a position."""
    new = bytes.fromhex(data)
    return [frame._replace(data=frame.data[:at] + new + frame.data[at + len(new) :])]


def _confirm(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    """Confirm a download without executing it."""
    proxy.answer(_SDO_RESPONSE, b"\x60" + frame.data[1:4] + bytes(4))
    return []


def _state(proxy: Proxy) -> NmtState:
    return proxy.bench.nodes[0].state


# --- NMT and heartbeat


@_response("nmt-boot-up-after-reset-node", _HEARTBEAT, "00")
def no_boot_up_message(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return []


@_response("nmt-boot-up-after-reset-communication", _HEARTBEAT, "00")
def two_boot_up_messages(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return [frame, frame]


@_response("nmt-start", _HEARTBEAT, "05")
def heartbeat_with_a_wrong_state(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 0, "7F")


@_request("nmt-stop", _NMT, "02")
def nmt_stop_is_ignored(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return []


@_request("nmt-broadcast", _NMT, "0100")
def nmt_to_all_nodes_is_ignored(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return []


@_request("nmt-other-node-is-ignored", _NMT)
def nmt_to_another_node_is_followed(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 1, "01")


@_request("nmt-unknown-command-is-ignored", _NMT, "42")
def unknown_nmt_command_is_a_start(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 0, "01")


@_request("nmt-wrong-length-is-ignored", _NMT)
def nmt_of_any_length_is_followed(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return [frame._replace(data=frame.data[:2])]


@_request("nmt-extended-frame-is-ignored", _NMT)
def extended_nmt_is_followed(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return [frame._replace(extended=False)]


@_request("nmt-no-sdo-while-stopped", _SDO_REQUEST)
def sdo_is_answered_while_stopped(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    if _state(proxy) is NmtState.STOPPED:
        proxy.answer(_SDO_RESPONSE, b"\x4f" + frame.data[1:4] + bytes(4))
    return [frame]


@_request("nmt-reset-communication-restores-parameters", _NMT, "82")
def reset_communication_keeps_parameters(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    proxy.answer(_HEARTBEAT, b"\0")
    return _with(frame, 0, "80")


@_request("nmt-node-guarding", _HEARTBEAT)
def remote_frame_is_answered(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    if frame.remote:
        proxy.answer(_HEARTBEAT, bytes([_state(proxy)]))
    return [frame]


@_response("heartbeat-period", _HEARTBEAT, "7F")
def every_second_heartbeat_is_missing(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    proxy.count += 1
    return [frame][proxy.count % 2 :]


@_request("heartbeat-off", _SDO_REQUEST, "2B171000 0000")
def heartbeat_cannot_be_switched_off(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 4, "32")


# --- SDO and object dictionary


@_request("sdo-toggle-bit", _SDO_REQUEST)
def toggle_bit_of_the_first_segment_is_ignored(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    is_first = proxy.count == 0x40
    proxy.count = frame.data[0]
    if is_first and frame.data[0] == 0x70:
        return _with(frame, 0, "60")
    return [frame]


@_response("sdo-no-object", _SDO_RESPONSE, "80", "00000206")
def another_abort_code(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 4, "00000008")


@_response("sdo-no-object", _SDO_RESPONSE, "80")
def aborts_name_another_object(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 1, "341200")


@_response("sdo-no-sub-index-of-a-variable", _SDO_RESPONSE, "80001001")
def a_variable_has_every_sub_index(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 0, "43")


def _accepts(item: str, name: str, where: str, code: str) -> None:
    """Add a slave that confirms a download that it must abort with a code."""

    def confirm(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
        return _with(frame, 0, "60")

    from_node = _only(confirm, _SDO_RESPONSE, "80" + where, code)
    BROKEN.append(BrokenSlave(name, item, pass_on, from_node))


_accepts("sdo-value-too-high", "high_limit_is_not_checked", "", "31000906")
_accepts("sdo-write-to-a-read-only-object", "read_only_can_be_written", "", "02000106")
_accepts("sdo-too-long", "download_that_is_too_long_is_accepted", "", "12000706")
_accepts("pdo-restricted-cob-ids", "restricted_cob_id_is_accepted", "001801", "")
_accepts("pdo-cob-id-change-while-valid", "valid_pdo_gets_another_cob_id", "001801", "")
_accepts("pdo-reserved-types", "reserved_type_is_accepted", "001802", "")
_accepts("pdo-mapping-too-long", "mapping_of_12_bytes_is_accepted", "", "42000406")
_accepts("sync-producer-is-refused", "sync_producer_bit_is_accepted", "051000", "")
_accepts("store-wrong-signature", "any_signature_stores", "101001", "")


@_request("sdo-unknown-command", _SDO_REQUEST, "E0")
def unknown_sdo_command_is_ignored(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return []


@_request("sdo-short-request", _SDO_REQUEST)
def short_sdo_request_is_a_whole_one(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return [frame._replace(data=frame.data.ljust(8, b"\0"))]


@_request("sdo-abort-by-the-client", _SDO_REQUEST, "80")
def abort_by_the_client_is_answered(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    proxy.answer(_SDO_RESPONSE, frame.data)
    return [frame]


@_response("sdo-segmented-upload", _SDO_RESPONSE, "41")
def announced_size_is_wrong(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 4, "01")


@_response("sdo-block-upload", _SDO_RESPONSE, end="0000000000")
def crc_of_block_transfer_is_wrong(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    if frame.data[0] & 0xE3 == 0xC1:
        return _with(frame, 1, "0000")
    return [frame]


@_response("od-values-are-the-defaults-of-the-eds", _SDO_RESPONSE, "4B171000")
def default_differs_from_the_eds(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 4, "E703")


@_response("od-no-communication-object-beyond-the-eds", _SDO_RESPONSE, "80071000")
def object_is_missing_in_the_eds(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 0, "43")


@_response("od-identity", _SDO_RESPONSE, "43181001")
def vendor_id_differs_from_the_eds(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 4, "99")


# --- PDO and SYNC


@_request("pdo-each-sync", _SYNC)
def sync_is_ignored(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return []


@_request("pdo-each-third-sync", _SDO_REQUEST, "2F001802 03")
def type_3_is_like_type_1(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 4, "01")


def _sends_tpdo(item: str, name: str, state: NmtState, is_valid: bool) -> None:
    """Add a slave that answers each SYNC with a TPDO in a forbidden state."""

    def send_tpdo(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
        first = proxy.bench.nodes[0].tpdos[0]
        if _state(proxy) is state and first.is_valid == is_valid:
            proxy.answer(_TPDO, bytes(8))
        return [frame]

    BROKEN.append(BrokenSlave(name, item, _only(send_tpdo, _SYNC, ""), pass_on))


_sends_tpdo(
    "pdo-none-in-pre-operational", "tpdo_in_pre_operational", NmtState.PRE_OPERATIONAL, True
)
_sends_tpdo("pdo-none-while-stopped", "tpdo_while_stopped", NmtState.STOPPED, True)
_sends_tpdo("pdo-disabled", "disabled_tpdo_is_sent", NmtState.OPERATIONAL, False)


@_request("pdo-event-timer", _SDO_REQUEST, "2B001805")
def event_timer_is_ignored(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    return _confirm(frame, proxy)


@_request("pdo-inhibit-time", _SDO_REQUEST, "2B001803")
def inhibit_time_is_ignored(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    return _confirm(frame, proxy)


@_request("sync-cob-id", _SDO_REQUEST, "23051000")
def cob_id_of_sync_is_ignored(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    return _confirm(frame, proxy)


# --- emergencies and stored parameters


@_response("emcy-lost-heartbeat", _EMCY)
def no_emergencies(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return []


@_response("emcy-lost-heartbeat", _EMCY)
def emergency_without_the_error_register(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 2, "00")


@_response("emcy-error-reset", _EMCY, "0000")
def end_of_an_error_is_not_reported(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return []


@_request("emcy-none-while-stopped", _NMT, "02")
def emergency_while_stopped(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    proxy.answer(_EMCY, bytes.fromhex("3081110000000000"))
    return [frame]


@_request("emcy-disabled", _SDO_REQUEST, "23141000")
def emergencies_cannot_be_disabled(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    return _confirm(frame, proxy)


@_response("emcy-history", _SDO_RESPONSE, "43031001")
def history_has_another_code(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 4, "0010")


@_request("emcy-error-behaviour", _SDO_REQUEST, "2F291001")
def error_behaviour_is_ignored(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    return _confirm(frame, proxy)


@_request("store-and-restore", _SDO_REQUEST, "23101001")
def save_is_confirmed_but_not_done(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    return _confirm(frame, proxy)


# --- LSS


@_request("lss-inquire-node-id", _LSS_REQUEST)
def lss_is_ignored(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return []


@_request("lss-silent-while-waiting", _LSS_REQUEST, "5E")
def lss_answers_while_waiting(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    if not proxy.bench.nodes[0].lss.is_configuring:
        proxy.answer(_LSS_RESPONSE, bytes.fromhex("5E01000000000000"))
    return [frame]


@_response("lss-inquire-identity", _LSS_RESPONSE, "5D")
def lss_has_another_serial_number(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 1, "99")


@_request("lss-switch-selective-of-another-slave", _LSS_REQUEST, "43")
def lss_selects_by_any_serial_number(frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    serial = proxy.bench.number(0x1018, 4).to_bytes(4, "little").hex()
    return _with(frame, 1, serial)


@_response("lss-invalid-node-id", _LSS_RESPONSE, "11")
def lss_accepts_any_node_id(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 1, "00")


@_request("lss-configure-node-id", _LSS_REQUEST, "11")
def lss_confirms_a_node_id_but_keeps_its_own(_frame: CanFrame, proxy: Proxy) -> list[CanFrame]:
    proxy.answer(_LSS_RESPONSE, bytes.fromhex("1100000000000000"))
    return []


@_request("lss-fastscan", _LSS_REQUEST, "51")
def fastscan_is_ignored(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return []


@_response("lss-store", _LSS_RESPONSE, "17")
def lss_store_fails(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return _with(frame, 1, "02")
