"""Makes a gateway with a recorder from a configuration."""

from pathlib import Path

from kontronik_can_gw.assembly.assemble import Loaded
from kontronik_can_gw.assembly.capture_setup import CaptureSetup
from kontronik_can_gw.capture.recorded_gateway import RecordedGateway, state_of
from kontronik_can_gw.config.export import as_toml
from kontronik_can_gw.config.keys import Config
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.files.event_recorder import EventRecorder, ring_bytes
from kontronik_can_gw.runtime.files.event_watch import EventWatch
from kontronik_can_gw.runtime.files.recorder import Recorder
from kontronik_can_gw.runtime.system.machine import state_folder

_STATE = "state"


def record_folder(config: Config, given: Path | None = None) -> Path | None:
    """Return the folder of captures, which is ``given`` or configured. None: no recording."""
    if given is not None or config.record.directory is None:
        return given
    if config.record.directory == _STATE:
        return state_folder() / "captures"
    return Path(config.file).parent / config.record.directory


def in_words(config: Config, folder: Path) -> str:
    """Describe folder and limits of the captures in a line."""
    record = config.record
    words = f"{folder}, parts of {record.part_mb} MB or {record.part_minutes} min"
    if record.keep_mb:
        words += f", {record.keep_mb} MB in all"
    return words


def events_in_words(config: Config) -> str:
    """Describe in a line when captures are recorded. Empty if everything is recorded."""
    record = config.record
    size = ring_size(config)
    if size is None:
        return ""
    return (
        f"on events, {record.before_s} s before to {record.after_s} s after, "
        f"at most {size / 1e6:.1f} MB in memory"
    )


def ring_size(config: Config) -> int | None:
    """Return the greatest size in bytes of the entries in memory. None without on_event."""
    return ring_bytes(config.record, len(config.esc)) if config.record.on_event else None


def recorded(
    loaded: Loaded,
    given: Path | None,
    now: int,
) -> tuple[Gateway, Recorder]:
    """Return the gateway of a configuration and its recorder.

    The folder of the captures is ``given`` or configured.
    """
    folder = record_folder(loaded.config, given)
    assert folder is not None
    record = loaded.config.record
    recorder = Recorder(folder, record)
    if record.on_event:
        recorder = EventRecorder(folder, record, len(loaded.escs))
    parts = (in_words(loaded.config, folder), events_in_words(loaded.config))
    recorder.words = ", ".join(filter(None, parts))
    gateway = RecordedGateway(
        recorder.put,
        loaded.core_settings,
        now,
        loaded.outputs,
    )
    if isinstance(recorder, EventRecorder):
        EventWatch(gateway, record, recorder.trigger)
    known = {
        "created_ns": now,
        "state": state_of(gateway),
        "layout": loaded.layout.fingerprint,
    }
    recorder.header = setup_of(loaded).header() | known
    return gateway, recorder


def setup_of(loaded: Loaded) -> CaptureSetup:
    """Return the configuration as it is stored in the header of a capture."""
    config = loaded.config
    dbc = (config.dbc_path.name, loaded.dbc) if config.dbc.enabled else None
    return CaptureSetup(
        tuple(loaded.escs),
        tuple(esc.port for esc in config.esc),
        dbc,
        config.dbc,
        config.can.fd,
        as_toml(config),
        config.file,
        outputs=loaded.outputs,
        core_numbers=loaded.core_settings.numbers,
    )
