"""Makes the recorder of a gateway from its configuration."""

from pathlib import Path

from kontronik_can_gw.capture.setup import CaptureSetup
from kontronik_can_gw.config.assemble import Loaded
from kontronik_can_gw.config.export import as_toml
from kontronik_can_gw.config.keys import Config
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.runtime.machine import state_folder
from kontronik_can_gw.runtime.recorder import Recorder, RecordSettings

_MB = 1_000_000
_STATE = "state"


def record_folder(config: Config, given: Path | None = None) -> Path | None:
    """The folder of captures, from the command line or the configuration; None: nothing is recorded."""
    if given is not None or config.record.directory is None:
        return given
    if config.record.directory == _STATE:
        return state_folder() / "captures"
    return Path(config.file).parent / config.record.directory


def in_words(config: Config, folder: Path) -> str:
    """Folder and limits of the captures, in a line."""
    record = config.record
    words = f"{folder}, parts of {record.part_mb} MB or {record.part_minutes} min"
    words += f", {record.keep_mb} MB in all" if record.keep_mb else ""
    return words


def recorder_of(config: Config, given: Path | None) -> Recorder:
    """The recorder, of a configuration or command line that names a folder."""
    record = config.record
    folder = record_folder(config, given)
    assert folder is not None
    recorder = Recorder(
        RecordSettings(
            folder,
            record.part_mb * _MB,
            record.part_minutes * 60 * SECOND,
            record.keep_mb * _MB,
            record.min_free_mb * _MB,
        )
    )
    recorder.words = in_words(config, folder)
    return recorder


def setup_of(loaded: Loaded) -> CaptureSetup:
    """The configuration as stored in the header of a capture."""
    config = loaded.config
    dbc = None
    if config.dbc.enabled:
        dbc = (config.dbc_path.name, loaded.dbc)
    return CaptureSetup(
        tuple(loaded.escs),
        tuple(esc.port for esc in config.esc),
        dbc,
        config.dbc_settings,
        config.can.fd,
        config.dbc.on_loss == "silent",
        loaded.canopen,
        as_toml(config),
        config.file,
    )
