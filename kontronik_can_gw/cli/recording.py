"""From a configuration to the recorder of a gateway."""

from pathlib import Path

from kontronik_can_gw.capture_setup import CaptureSetup
from kontronik_can_gw.cli.common import Loaded
from kontronik_can_gw.config import Config, as_toml
from kontronik_can_gw.runtime.machine import state_folder
from kontronik_can_gw.runtime.recorder import Recorder, RecordSettings
from kontronik_can_gw.telemetry import SECOND

_MB = 1_000_000
_STATE = "state"


def recorder_of(config: Config, folder: Path | None) -> Recorder | None:
    """The recorder; ``folder`` wins over the configuration's. None where nothing is to be recorded."""
    record = config.record
    if folder is None and record.directory is not None:
        folder = Path(config.file).parent / record.directory
        if record.directory == _STATE:
            folder = state_folder() / "captures"
    if folder is None:
        return None
    return Recorder(
        RecordSettings(
            folder,
            record.part_mb * _MB,
            record.part_minutes * 60 * SECOND,
            record.keep_mb * _MB,
            record.min_free_mb * _MB,
            record.can_log,
            config.can.channel,
        )
    )


def setup_of(loaded: Loaded) -> CaptureSetup:
    """What the header of a capture holds of a configuration."""
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
