#!/bin/sh
# Creates .venv with the project on a fresh Debian or Ubuntu.
#   bootstrap.sh demo|lint|test|test-all|prove|pictures|wheels|release
#   demo      the project
#   lint      the same and its test tools
#   test      the same, a C compiler and small tools of some tests. If the kernel has no vcan for this
#             user, also User Mode Linux.
#   test-all  the same, User Mode Linux in any case, systemd, a browser, an MQTT broker, and CANopen
#             masters of other projects (tests/foreign)
#   prove     `lint` and a C compiler
#   pictures  `lint` and a browser
#   wheels    `lint`, cross compilers and qemu-user
#   release   `test` and both virtual machines of the fault programme, which are User Mode Linux and
#             QEMU with a kernel (90 MB); clang, cross compilers and their QEMU; debootstrap, lintian
# A second call has no effect. PYTHON is the interpreter to use.
# Debian packages are installed by root, or by a sudo without a password. For another user they are
# unpacked in .venv/debian, and Zig of PyPI is the C compiler.
set -eu

what=${1:?demo, lint, test, test-all, prove, pictures, wheels or release}
cd "$(dirname "$0")/.."
venv=.venv/bin/python
new_enough='import sys; sys.exit(sys.version_info < (3, 11))'

say() { echo "set-up: $*" >&2; }
die() { say "$@"; exit 1; }

can_root() { command -v apt-get >/dev/null && { [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null; }; }
as_root() { if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi; }

# Collects programs that this user may not install. One line reports them at the end.
left_out=
lacks=
lacking() { # $1: packages, $2: for what
    lacks="$lacks $1"
    case $left_out in *"$2"*) ;; *) left_out="$left_out${left_out:+; }$2" ;; esac
}

apt_update() {
    [ -z "${VM_APT_UPDATED:-}" ] || return 0
    say "package lists"
    as_root apt-get -qq -o DPkg::Lock::Timeout=120 update </dev/null >&2 || say "apt-get update: failed; going on"
    VM_APT_UPDATED=1
    export VM_APT_UPDATED
}

# Debian packages of a user who may not install them. They and the missing libraries are unpacked in
# .venv/debian, by package lists of its own.
debian=$PWD/.venv/debian
own_apt() {
    apt-get -qq -o Dir::State="$debian/state" -o Dir::State::status=/var/lib/dpkg/status \
        -o Dir::Cache="$debian/cache" -o Debug::NoLocking=1 "$@" </dev/null >&2
}

unpack() { # packages
    command -v apt-get >/dev/null && command -v dpkg-deb >/dev/null || return 1
    if [ ! -e "$debian/root" ]; then
        say "package lists, in .venv"
        mkdir -p "$debian/state/lists/partial" "$debian/cache/archives/partial"
        own_apt update || return 1
        mkdir "$debian/root"
    fi
    say "unpacked in .venv: $*"
    own_apt -y --no-install-recommends --download-only install "$@" >/dev/null 2>&1 || return 1
    for archive in "$debian"/cache/archives/*.deb; do
        [ -e "$archive" ] || continue
        dpkg-deb -x "$archive" "$debian/root" || return 1
        rm "$archive"
    done
    link_unpacked
}

# Puts the unpacked programs that the machine lacks in .venv/bin: a script for a program that needs
# an unpacked library, a link for any other.
link_unpacked() {
    libraries=$(find "$debian/root" -path '*/lib/*-linux-gnu*/lib*.so*' -exec dirname {} + | sort -u | tr '\n' ':')
    for program in "$debian"/root/bin/* "$debian"/root/sbin/* "$debian"/root/usr/bin/* "$debian"/root/usr/sbin/*; do
        own=$PWD/.venv/bin/${program##*/}
        [ -x "$program" ] && ! [ -e "$own" ] && ! command -v "${program##*/}" >/dev/null || continue
        if ldd "$program" 2>/dev/null | grep -q 'not found'; then
            printf '#!/bin/sh\nLD_LIBRARY_PATH="%s$LD_LIBRARY_PATH" exec "%s" "$@"\n' "$libraries" "$program" >"$own"
            chmod 755 "$own"
        else
            ln -s "$program" "$own"
        fi
    done
}

# A C compiler from PyPI, for a user who may not install another one.
unpack_compiler() {
    say "a C compiler in .venv: Zig"
    "$venv" -m pip install -q --disable-pip-version-check --no-input ziglang >&2 </dev/null || return 1
    zig=$("$venv" -c 'import ziglang; print(ziglang.__path__[0])')/zig
    for name in cc c++; do
        printf '#!/bin/sh\nZIG_GLOBAL_CACHE_DIR="%s" exec "%s" %s -fno-sanitize=undefined "$@"\n' \
            "$PWD/.venv/zig-cache" "$zig" $name >.venv/bin/$name
        chmod 755 .venv/bin/$name
    done
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
            as_root env DEBIAN_FRONTEND=noninteractive DEBCONF_NOWARNINGS=yes apt-get -qq -o DPkg::Lock::Timeout=120 \
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
    key="$(cat pyproject.toml hatch_build.py kontronik_can_gw/native/*.[ch] kontronik_can_gw/esc/kontronik/*.py | cksum) $(command -v cc || command -v gcc || :) $PWD"
    for done in "$stamp" .venv/.installed-test; do
        [ -e "$done" ] && [ "$(cat "$done")" = "$key" ] && return
    done
    "$venv" -m pip --version >/dev/null 2>&1 || "$venv" -m ensurepip >/dev/null || die "no pip in .venv"
    say "the project and what it needs (pip install -e $2)"
    # Without PIP_USE_PEP517 an old pip builds by setup.py and warns.
    PIP_USE_PEP517=1 "$venv" -m pip install -q --disable-pip-version-check --no-input -e "$2" >&2 </dev/null || die "pip failed"
    echo "$key" >"$stamp"
}

vm_programs="user-mode-linux can-utils iproute2 busybox-static"
vm_packages="$vm_programs gcc libc6-dev"
vm_line="sudo apt-get install $vm_packages"

# User Mode Linux 6.1 does not support the registers of the newest processors. It needs uml_xstate.c
# to start there.
uml_has_started() { # an earlier set-up has installed and tried User Mode Linux
    key=$(cksum <tests/vm/uml_xstate.c)
    command -v linux.uml >/dev/null && [ "$(cat .venv/.uml-starts 2>/dev/null)" = "$key" ]
}

install_uml() {
    uml_has_started && return
    for program in linux.uml busybox cc ip candump; do
        command -v $program >/dev/null && continue
        if ! can_root; then
            command -v cc >/dev/null && unpack $vm_programs && break
            lacking "$vm_packages" "a kernel with vcan"
            return 1
        fi
        apt_update
        say "User Mode Linux"
        tests/vm/setup.sh uml || { say "failed; by hand:  $vm_line"; return 1; }
        break
    done
    if ! "$venv" -B tests/vm/vm_run.py --backend uml --timeout 60 -- true 2>/dev/null; then
        say "it does not start on this processor by itself: tests/vm/uml_xstate.c"
        tests/vm/setup.sh xstate && "$venv" -B tests/vm/vm_run.py --backend uml --timeout 60 -- true || return 1
    fi
    echo "$key" >.venv/.uml-starts
}

# vcan natively needs ip and candump; a VM needs them and User Mode Linux.
install_vcan() {
    PATH=$PATH:/usr/sbin:/sbin
    if ! command -v ip >/dev/null || ! command -v candump >/dev/null; then
        if can_root; then
            apt_update
            say "can-utils, iproute2"
            tests/vm/setup.sh || { say "failed; by hand:  $vm_line"; return; }
        elif ! unpack can-utils iproute2; then
            lacking "$vm_packages" "a kernel with vcan"
            return
        fi
    fi
    has_vcan && return
    uml_has_started && return
    extra=linux-modules-extra-$(uname -r) # Ubuntu's package with vcan
    if can_root && apt_update && apt-cache show "$extra" >/dev/null 2>&1; then
        say "$extra (vcan)"
        as_root env DEBIAN_FRONTEND=noninteractive DEBCONF_NOWARNINGS=yes apt-get -qq -o DPkg::Lock::Timeout=120 \
            install -y --no-install-recommends "$extra" </dev/null >/dev/null || say "failed; going on"
        has_vcan && return
    fi
    install_uml && return
    can_root || return 0
    say "User Mode Linux does not start here: QEMU"
    tests/vm/setup.sh qemu || say "failed; by hand:  sudo tests/vm/setup.sh qemu"
}

has_vcan() { # natively, or by a VM other than User Mode Linux
    case $("$venv" -B tests/vm/vm_run.py --which) in native | qemu) ;; *) false ;; esac
}

# install_programs WHY PROGRAM[=PACKAGES]...
# Installs the packages of missing programs one by one. A package that cannot be installed is left out.
install_programs() {
    PATH=$PATH:/usr/sbin:/sbin
    why=$1
    wanted=
    shift
    for each in "$@"; do command -v "${each%%=*}" >/dev/null || wanted="$wanted $(echo "${each#*=}" | tr , ' ')"; done
    [ -n "$wanted" ] || return 0
    can_root || unpack $wanted || lacking "$wanted" "$why"
    can_root || return 0
    apt_update
    say "$why:$wanted"
    for package in $wanted; do
        as_root env DEBIAN_FRONTEND=noninteractive DEBCONF_NOWARNINGS=yes apt-get -qq -o DPkg::Lock::Timeout=120 \
            install -y --no-install-recommends "$package" </dev/null >/dev/null || say "$package: failed; going on"
    done
}

install_small_tools() {
    install_programs "what screens, completion and benchmarks are tried with" tmux zsh openssl jq
}

install_cpp() { command -v c++ >/dev/null || install_programs "a C++ compiler" g++; }

install_file_systems() {
    install_programs "file systems after a loss of power" mkfs.ext4=e2fsprogs mkfs.f2fs=f2fs-tools mkfs.vfat=dosfstools
}

install_clang() { install_programs "a second C compiler, with a fuzzer" clang=clang,libclang-rt-dev; }

install_browser() { command -v google-chrome >/dev/null || install_programs "a browser" chromium; }

# Faults that set clocks and mount file systems never run on the machine itself.
install_vm() { # $1: uml or qemu
    PATH=$PATH:/usr/sbin:/sbin
    case $1 in
        uml) install_uml || say "the fault programme cannot run"; return ;;
        qemu) command -v qemu-system-x86_64 >/dev/null && grep -qs vhci_hcd "${VM_CACHE:-tests/vm/.cache}"/*/modules && return ;;
    esac
    can_root || { say "cannot install what the fault programme needs:  sudo tests/vm/setup.sh $1"; return; }
    apt_update
    say "for the fault programme: $1"
    tests/vm/setup.sh "$1" || say "failed; by hand:  sudo tests/vm/setup.sh $1"
}

# With a C compiler the C core is built when the project is installed. Otherwise the Python core runs.
install_compiler() {
    command -v cc >/dev/null || command -v gcc >/dev/null && return
    can_root || unpack_compiler && return
    install_programs "a C compiler" gcc=gcc,libc6-dev
}

install_other_machines() {
    install_programs "the core in C on other machines" arm-none-eabi-gcc=gcc-arm-none-eabi,libnewlib-arm-none-eabi \
        s390x-linux-gnu-gcc=gcc-s390x-linux-gnu,libc6-dev-s390x-cross qemu-system-arm
}

install_cross_compilers() {
    install_programs "compilers for other machines" x86_64-linux-gnu-gcc=gcc-x86-64-linux-gnu,libc6-dev-amd64-cross \
        aarch64-linux-gnu-gcc=gcc-aarch64-linux-gnu,libc6-dev-arm64-cross \
        arm-linux-gnueabihf-gcc=gcc-arm-linux-gnueabihf,libc6-dev-armhf-cross qemu-arm=qemu-user
}

[ -x "$venv" ] && "$venv" -c "$new_enough" 2>/dev/null || make_venv
export PATH="$PWD/.venv/bin:$PATH"
case $what in
    demo) install_project demo '.[web]' ;;
    lint) install_project test '.[test]' ;;
    test) install_compiler; install_project test '.[test]'; install_vcan; install_small_tools; install_cpp ;;
    test-all)
        install_compiler
        # This needs a minute of processor time besides the downloads. The call below reports failures.
        tests/foreign/install.sh masters 2>/dev/null &
        install_project test '.[test]'
        install_vcan
        install_small_tools
        install_cpp
        install_vm uml
        install_file_systems
        install_browser
        install_clang
        install_programs "systemd, a broker, Prometheus" systemd-analyze=systemd mosquitto mosquitto_sub=mosquitto-clients prometheus
        wait
        tests/foreign/install.sh || say "tests with the masters named above are left out"
        ;;
    release)
        install_compiler
        install_project test '.[test]'
        install_vcan
        install_vm uml
        install_file_systems
        install_vm qemu
        install_clang
        install_cross_compilers
        install_other_machines
        install_programs "a proof that the core has no undefined behaviour" frama-c=frama-c-base
        install_programs "Debian packages in fresh roots" debootstrap lintian
        ;;
    prove) install_compiler; install_project test '.[test]' ;;
    pictures) install_project test '.[test]'; install_browser ;;
    wheels) install_project test '.[test]'; install_cross_compilers ;;
    *) die "$what: demo, lint, test, test-all, prove, pictures, wheels or release" ;;
esac
packages=$(echo "$lacks" | tr -s ' ' '\n' | sort -u | tr '\n' ' ')
[ -z "$lacks" ] || say "tests are left out, for there is no right to install $left_out. By hand:  sudo apt-get install$packages"
