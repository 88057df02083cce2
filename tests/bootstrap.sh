#!/bin/sh
# Makes .venv with the project in it, by itself, on a fresh Debian or Ubuntu:  bootstrap.sh demo|lint|test|hardware
#   demo  the project
#   lint  and its test tools
#   test  and, where the kernel has no vcan for us, User Mode Linux, if we are root or sudo asks nothing; and the CANopen
#         masters of others that the node is tried with (tests/foreign); what `hardware` installs; systemd; a browser, an MQTT broker
#   hardware  and the two virtual machines of the fault programme: User Mode Linux; QEMU with a kernel, 90 MB
# A second call does nothing. PYTHON: the interpreter to use.
set -eu

what=${1:?demo, lint, test or hardware}
cd "$(dirname "$0")/.."
venv=.venv/bin/python
new_enough='import sys; sys.exit(sys.version_info < (3, 11))'

say() { echo "set-up: $*" >&2; }
die() { say "$@"; exit 1; }

can_root() { command -v apt-get >/dev/null && { [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null; }; }
as_root() { if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi; }

apt_update() {
    [ -z "${VM_APT_UPDATED:-}" ] || return 0
    say "package lists"
    as_root apt-get -qq -o DPkg::Lock::Timeout=120 update </dev/null >&2 || say "apt-get update: failed; going on"
    VM_APT_UPDATED=1
    export VM_APT_UPDATED
}

find_python() {
    for python in ${PYTHON:-} python3 python3.13 python3.12 python3.11 python3.14; do
        if "$python" -c "$new_enough" 2>/dev/null; then
            echo "$python"
            return
        fi
    done
    return 1
}

make_venv() {
    python=$(find_python) || die "no Python 3.11 or newer; install it:  sudo apt-get install python3 python3-venv"
    say "virtual environment, $("$python" --version)"
    rm -rf .venv
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        package=$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
        if "$python" -m virtualenv --version >/dev/null 2>&1; then
            "$python" -m virtualenv -q .venv
            return
        elif can_root; then
            apt_update
            say "$package"
            as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=120 \
                install -y --no-install-recommends "$package" </dev/null >/dev/null ||
                die "cannot install $package"
        else
            die "Python cannot make a virtual environment; first:  sudo apt-get install $package"
        fi
    fi
    "$python" -m venv .venv || { rm -rf .venv; die "cannot make .venv"; }
}

install_project() { # $1: demo or test, $2: what pip installs
    stamp=.venv/.installed-$1
    key="$(cksum <pyproject.toml) $PWD"
    for done in "$stamp" .venv/.installed-test; do
        [ -e "$done" ] && [ "$(cat "$done")" = "$key" ] && return
    done
    "$venv" -m pip --version >/dev/null 2>&1 || "$venv" -m ensurepip >/dev/null || die "no pip in .venv"
    say "the project and what it needs (pip install -e $2)"
    # PIP_USE_PEP517: an old pip builds by setup.py otherwise, and warns
    PIP_USE_PEP517=1 "$venv" -m pip install -q --disable-pip-version-check --no-input -e "$2" >&2 </dev/null || die "pip failed"
    echo "$key" >"$stamp"
}

vm_line="sudo apt-get install user-mode-linux can-utils iproute2 busybox-static"

# vcan natively needs ip and candump; a VM needs them and User Mode Linux.
install_vcan() {
    PATH=$PATH:/usr/sbin:/sbin
    if ! command -v ip >/dev/null || ! command -v candump >/dev/null; then
        can_root || { say "cannot install what the vcan tests need:  $vm_line"; return; }
        apt_update
        say "can-utils, iproute2"
        tests/vm/setup.sh || { say "failed; by hand:  $vm_line"; return; }
    fi
    "$venv" -B tests/vm/vm_run.py --which >/dev/null && return
    extra=linux-modules-extra-$(uname -r) # Ubuntu has vcan in there
    if can_root && apt_update && apt-cache show "$extra" >/dev/null 2>&1; then
        say "$extra (vcan)"
        as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=120 \
            install -y --no-install-recommends "$extra" </dev/null >/dev/null || say "failed; going on"
        "$venv" -B tests/vm/vm_run.py --which >/dev/null && return
    fi
    can_root || { say "no vcan in this kernel, and cannot install User Mode Linux:  $vm_line"; return; }
    say "User Mode Linux (this kernel has no vcan for us)"
    tests/vm/setup.sh uml || { say "failed; by hand:  $vm_line"; return; }
    "$venv" -B tests/vm/vm_run.py --timeout 60 -- true && return
    say "User Mode Linux does not start here: QEMU"
    tests/vm/setup.sh qemu || say "failed; by hand:  sudo tests/vm/setup.sh qemu"
}

# systemd's own checks of the service, and a real one that runs it in a virtual machine.
install_systemd() {
    command -v systemd-analyze >/dev/null && return
    can_root || { say "no systemd to check the service with:  sudo apt-get install systemd"; return; }
    apt_update
    say "systemd, for the tests of the service"
    as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=120 \
        install -y --no-install-recommends systemd </dev/null >/dev/null || say "failed; going on"
}

# What the reports, the MQTT publisher, the screens, the completion, the manual page and the benchmarks are tried with.
install_viewers() {
    PATH=$PATH:/usr/sbin:/sbin
    wanted=
    command -v chromium >/dev/null || command -v google-chrome >/dev/null || wanted="$wanted chromium"
    command -v mosquitto >/dev/null || wanted="$wanted mosquitto"
    command -v mosquitto_sub >/dev/null || wanted="$wanted mosquitto-clients"
    command -v groff >/dev/null || wanted="$wanted groff-base"
    command -v gcc >/dev/null || wanted="$wanted gcc libc6-dev"
    for tool in tmux zsh mandoc openssl; do command -v $tool >/dev/null || wanted="$wanted $tool"; done
    [ -n "$wanted" ] || return 0
    can_root || { say "tests that need them are left out; they come with:  sudo apt-get install$wanted"; return; }
    apt_update
    say "for the tests:$wanted"
    for package in $wanted; do
        as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=120 \
            install -y --no-install-recommends "$package" </dev/null >/dev/null || say "$package: failed; going on"
    done
}

# The faults that set clocks and mount file systems are never tried on the machine itself.
install_hardware() {
    PATH=$PATH:/usr/sbin:/sbin
    if ! command -v linux.uml >/dev/null; then
        can_root || { say "cannot install User Mode Linux for the fault programme:  $vm_line"; return; }
        apt_update
        say "User Mode Linux for the fault programme"
        tests/vm/setup.sh uml || say "failed; by hand:  $vm_line"
    fi
    if ! command -v qemu-system-x86_64 >/dev/null || ! grep -qs vhci_hcd "${VM_CACHE:-tests/vm/.cache}"/*/modules; then
        can_root || { say "cannot install QEMU for the fault programme:  sudo tests/vm/setup.sh qemu"; return; }
        apt_update
        say "QEMU with a kernel for the fault programme"
        tests/vm/setup.sh qemu || say "failed; by hand:  sudo tests/vm/setup.sh qemu"
    fi
}

[ -x "$venv" ] && "$venv" -c "$new_enough" 2>/dev/null || make_venv
case $what in
    demo) install_project demo . ;;
    lint) install_project test '.[test]' ;;
    hardware) install_project test '.[test]'; install_hardware ;;
    test) install_project test '.[test]'; install_vcan; install_hardware; install_systemd; install_viewers; tests/foreign/install.sh || say "tests with the masters named above are left out" ;;
    *) die "$what: demo, lint, test or hardware" ;;
esac
