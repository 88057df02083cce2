#!/bin/sh
# Installs programs of others that tests/vcan/test_foreign_masters.py and tests/dronecan/test_foreign_reader.py use:
#   canopen     a master in JavaScript, by npm         about 10 s, needs node, npm, make, g++ and python3
#   dronecan    a reader of DroneCAN in Rust, by cargo   about 20 s, needs cargo and a C linker
#   axe-core    finds barriers in the live page (tests/live), by npm   about 3 s, needs npm
#   tshark      Wireshark's decoder, from Debian       about 25 s, needs root or a sudo that asks nothing
# They go to tests/foreign/.cache, tshark to the system. What is there already is left alone. What cannot be had is
# named, and the others are installed all the same; the exit code then is 1.
# VM_APT_UPDATED=1: the package lists are fresh. "install.sh masters": not tshark, so without apt.
set -u

here=$(cd "$(dirname "$0")" && pwd)
cache=$here/.cache
missing=0

say() { echo "foreign masters: $*" >&2; }
lacks() { say "$@"; missing=1; }
have() { command -v "$1" >/dev/null 2>&1; }

# Quiet, but the end of the log when it fails.
quietly() {
    if "$@" >"$log" 2>&1 </dev/null; then return; fi
    tail -n 30 "$log" >&2
    return 1
}

mkdir -p "$cache" || exit 1
log=$(mktemp) || exit 1
trap 'rm -f "$log"' EXIT

install_dronecan_reader() {
    target=$cache/dronecan_reader
    [ -x "$target/release/dronecan-reader" ] && [ "$target/release/dronecan-reader" -nt "$here/dronecan_reader/src/main.rs" ] && return
    have cargo || { lacks "dronecan-reader: no cargo: install Rust and run $0 again"; return; }
    say "dronecan-reader (cargo build)"
    quietly cargo build --release --locked --manifest-path "$here/dronecan_reader/Cargo.toml" --target-dir "$target" ||
        lacks "dronecan-reader: cargo build failed"
}

install_node_canopen() {
    key="$(cksum <"$here/package-lock.json") $(node --version 2>/dev/null)"
    [ "$(cat "$cache/node/installed" 2>/dev/null)" = "$key" ] && return
    for tool in node npm make g++; do
        have $tool || { lacks "node canopen: no $tool:  sudo apt-get install nodejs npm make g++"; return; }
    done
    say "canopen for node (npm ci)"
    rm -rf "$cache/node"
    mkdir -p "$cache/node"
    cp "$here/package.json" "$here/package-lock.json" "$cache/node"
    if quietly npm ci --prefix "$cache/node" --no-audit --no-fund --loglevel=error; then
        echo "$key" >"$cache/node/installed"
    else
        lacks "node canopen: npm ci failed"
    fi
}

install_axe() {
    key="$(cksum <"$here/../live/axe/package-lock.json")"
    [ "$(cat "$cache/axe/installed" 2>/dev/null)" = "$key" ] && return
    have npm || { lacks "axe-core: no npm:  sudo apt-get install npm"; return; }
    say "axe-core (npm ci)"
    rm -rf "$cache/axe"
    mkdir -p "$cache/axe"
    cp "$here/../live/axe/package.json" "$here/../live/axe/package-lock.json" "$cache/axe"
    if quietly npm ci --prefix "$cache/axe" --no-audit --no-fund --loglevel=error; then
        echo "$key" >"$cache/axe/installed"
    else
        lacks "axe-core: npm ci failed"
    fi
}

install_tshark() {
    have tshark && return
    if [ "$(id -u)" = 0 ]; then
        sudo=
    elif sudo -n true 2>/dev/null; then
        sudo="sudo -n"
    else
        lacks "tshark is missing:  sudo apt-get install tshark"
        return
    fi
    apt="$sudo env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=120"
    say "tshark"
    [ -n "${VM_APT_UPDATED:-}" ] || quietly $apt update || say "apt-get update: failed; going on"
    quietly $apt install -y --no-install-recommends tshark || lacks "tshark: apt-get install failed"
}

[ "${1:-}" = masters ] || install_tshark
install_node_canopen
install_axe
install_dronecan_reader
exit $missing
