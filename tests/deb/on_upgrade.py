"""systemd runs this script in a booted Debian root (boot_root.sh).

It upgrades, removes and purges the package while the gateway runs, and writes the facts to
/media/facts.json.
"""

import json
from pathlib import Path

from on_board import fresh, run

UNIT = "kontronik-can-gw.service"


def unit() -> dict[str, str]:
    names = "MainPID,ActiveState,LoadState,NRestarts,FragmentPath"
    lines = run("systemctl", "show", "-p", names, UNIT).split()
    return dict(line.split("=", 1) for line in lines)


def main() -> None:
    said = run("kontronik-can-gw", "service", "install", "--now")
    facts = {"fresh": fresh(), "installed": unit(), "install said": said}
    facts["upgrade said"] = run("dpkg", "-i", "/media/newer.deb")
    facts |= {"fresh after upgrade": fresh(), "upgraded": unit()}
    facts["removal said"] = run("dpkg", "-r", "kontronik-can-gw")
    facts["removed"] = unit()
    facts["purge said"] = run("dpkg", "-P", "kontronik-can-gw")
    facts["left"] = run("find", "/run", "/etc", "/var/lib", "-name", "*kontronik*")
    Path("/media/facts.json").write_text(json.dumps(facts, indent=1))


if __name__ == "__main__":
    main()
