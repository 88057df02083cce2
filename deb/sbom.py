"""Makes the software bill of materials of the Debian packages, as CycloneDX 1.6 in JSON.

It lists the gateway, its core in C, and the libraries with their versions, licences, hashes and
dependencies, as their wheels state them. Two builds of the same sources give the same text: the
time is the time of all files in the package, and the serial number is derived from the content.
"""

import hashlib
import json
import re
import uuid
import zipfile
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from email import message_from_string
from email.message import Message
from pathlib import Path
from typing import Any

_NAMESPACE = uuid.UUID("6ba7b811-9dad-11d1-80b4-00c04fd430c8")
"""The name space of URLs in RFC 4122."""
_LICENCES = {
    "License :: OSI Approved :: Apache Software License": "Apache-2.0",
    "License :: OSI Approved :: BSD License": "BSD-3-Clause",
    "License :: OSI Approved :: MIT License": "MIT",
    "License :: OSI Approved :: Python Software Foundation License": "PSF-2.0",
    "License :: OSI Approved :: GNU Lesser General Public License v3 (LGPLv3)": "LGPL-3.0-only",
}
"""SPDX names of classifiers, for wheels that state no SPDX name."""
_SPDX = {
    "MIT": "MIT",
    "MPL-2.0": "MPL-2.0",
    "BSD": "BSD-3-Clause",
    "LGPL v3": "LGPL-3.0-only",
    "MIT License": "MIT",
}
"""SPDX names of other spellings in the field License."""


def metadata_of(wheel: Path) -> Message:
    """Return the metadata of a wheel. If it has none, they consist of its file's name."""
    with zipfile.ZipFile(wheel) as file:
        for name in file.namelist():
            if re.fullmatch(r"[^/]+\.dist-info/METADATA", name):
                return message_from_string(file.read(name).decode())
    name, _, version = wheel.stem.partition("-")
    found = Message()
    found["Name"] = name
    found["Version"] = version.partition("-")[0] or "0"
    return found


def bill_of_materials(
    package: Mapping[str, str], core: tuple[str, bytes], libraries: Sequence[Path], seconds: int
) -> str:
    """Return the document of a package.

    ``package`` has its name, version and architecture. ``core`` is the name and content of the
    shared object. ``libraries`` are the wheels in the package, and ``seconds`` is the time of its
    files.
    """
    name = package["name"]
    purl = f"pkg:deb/{name}@{package['version']}?arch={package['architecture']}"
    file, content = core
    components: list[dict[str, Any]] = [
        {
            "type": "file",
            "bom-ref": file,
            "name": file,
            "description": "the gateway's core, compiled from the C sources of this package",
            "hashes": [_sha256(content)],
            "licenses": [{"license": {"id": "MIT"}}],
        }
    ]
    found = sorted(
        (_key(metadata["Name"]), metadata, wheel)
        for metadata, wheel in ((metadata_of(wheel), wheel) for wheel in libraries)
    )
    references = {key: _purl(metadata) for key, metadata, _ in found}
    dependencies = [{"ref": purl, "dependsOn": sorted([file, *references.values()])}]
    for key, metadata, wheel in found:
        components.append(_component(metadata, wheel))
        needed = [
            _key(text) for text in metadata.get_all("Requires-Dist", []) if "extra" not in text
        ]
        depends_on = sorted({references[each] for each in needed if each in references})
        dependencies.append({"ref": references[key], "dependsOn": depends_on})
    document: dict[str, Any] = {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {
            "timestamp": datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            "component": {
                "type": "application",
                "bom-ref": purl,
                "name": name,
                "version": package["version"],
                "purl": purl,
                "licenses": [{"license": {"id": "MIT"}}],
            },
        },
        "components": components,
        "dependencies": dependencies,
    }
    text = json.dumps(document, sort_keys=True)
    document["serialNumber"] = f"urn:uuid:{uuid.uuid5(_NAMESPACE, text)}"
    return json.dumps(document, indent=1, sort_keys=True) + "\n"


def _component(metadata: Message, wheel: Path) -> dict[str, Any]:
    found: dict[str, Any] = {
        "type": "library",
        "bom-ref": _purl(metadata),
        "name": metadata["Name"],
        "version": metadata["Version"],
        "purl": _purl(metadata),
        "description": metadata["Summary"] or "",
        "hashes": [_sha256(wheel.read_bytes())],
    }
    licence = licence_of(metadata)
    if licence:
        found["licenses"] = [licence]
    return found


def licence_of(metadata: Message) -> dict[str, Any] | None:
    """Return the licence that a wheel states, by its SPDX name if that is known."""
    expression = metadata["License-Expression"]
    if expression:
        return {"expression": expression}
    stated = (metadata["License"] or "").strip()
    if stated in _SPDX:
        return {"license": {"id": _SPDX[stated]}}
    for classifier in metadata.get_all("Classifier", []):
        if classifier in _LICENCES:
            return {"license": {"id": _LICENCES[classifier]}}
    if stated and "\n" not in stated:
        return {"license": {"name": stated}}
    return None


def _purl(metadata: Message) -> str:
    return f"pkg:pypi/{_key(metadata['Name'])}@{metadata['Version']}"


def _key(requirement: str) -> str:
    """Return the normalised name at the beginning of a requirement (PEP 503)."""
    found = re.match(r"[\w.-]*\w", requirement)
    return re.sub(r"[-_.]+", "-", found[0] if found else "").lower()


def _sha256(content: bytes) -> dict[str, str]:
    return {"alg": "SHA-256", "content": hashlib.sha256(content).hexdigest()}
