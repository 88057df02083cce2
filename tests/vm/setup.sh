#!/bin/sh
# Installs the programs for tests/vm/run on Debian and Ubuntu:  setup.sh [uml] [xstate] [qemu]
#   (nothing)  can-utils and iproute2, which are enough if the running kernel has vcan
#   uml        User Mode Linux, 41 MB, and a C compiler; `make test` uses it without vcan
#   xstate     the library that it needs on a processor with AMX (uml_xstate.c)
#   qemu       QEMU and Debian's stock kernel, 90 MB, for serial ports, CAN controllers and vcan
# Needs root, or a sudo without a password, if a package is missing. The kernel for QEMU is downloaded
# and unpacked, not installed. VM_CACHE is the folder for it (tests/vm/.cache). VM_APT_UPDATED=1 means
# that the package lists are fresh.
set -eu

here=$(cd "$(dirname "$0")" && pwd)
cache=${VM_CACHE:-$here/.cache}
packages="can-utils iproute2"
qemu=no
xstate=no
for part in "$@"; do
    case $part in
        uml) packages="$packages busybox-static user-mode-linux gcc libc6-dev" ;;
        xstate) xstate=yes ;;
        qemu) packages="$packages busybox-static qemu-system-x86 kmod cpio xz-utils zstd" qemu=yes ;;
        *) echo "usage: setup.sh [uml] [xstate] [qemu]" >&2; exit 2 ;;
    esac
done

apt() { $sudo env DEBIAN_FRONTEND=noninteractive DEBCONF_NOWARNINGS=yes apt-get -qq -o DPkg::Lock::Timeout=120 "$@" </dev/null; }

# Quiet, but the whole log when it fails.
install() {
    if [ "$(id -u)" = 0 ]; then
        sudo=
    elif sudo -n true 2>/dev/null; then
        sudo="sudo -n"
    else
        echo "setup.sh: needs root:  sudo apt-get install $*" >&2
        exit 1
    fi
    log=$(mktemp)
    if { [ -n "${VM_APT_UPDATED:-}" ] || apt update; apt install -y --no-install-recommends "$@"; } >"$log" 2>&1; then
        rm -f "$log"
    else
        cat "$log" >&2
        rm -f "$log"
        echo "setup.sh: apt-get install $*: failed" >&2
        exit 1
    fi
}

work=
trap '[ -z "$work" ] || rm -rf "$work"' EXIT

missing=
for package in $packages; do
    dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q ' installed$' || missing="$missing $package"
done
[ -z "$missing" ] || install $missing
if [ $xstate = yes ]; then
    mkdir -p "$cache"
    cc -O2 -Wall -shared -fPIC -o "$cache/uml_xstate.so" "$here/uml_xstate.c" -ldl
fi
[ $qemu = yes ] || exit 0

# --- QEMU: the distribution's kernel and an initrd that hands over to the host's file system
package=$(apt-cache depends linux-image-amd64 | awk '/Depends: linux-image-/ { print $2; exit }')
version=${package#linux-image-}
if [ -z "$version" ]; then
    echo "setup.sh: no linux-image-amd64 in this distribution; the QEMU part is for Debian on amd64" >&2
    exit 1
fi
# Modules for vcan, slcan, the CAN controllers, the serial adapter, and simulated USB devices
# (vhci_hcd).
modules="virtio_pci virtio_console 9pnet_virtio 9p can can_raw can_bcm can_gw can_isotp can_j1939 vcan vxcan slcan sch_tbf
sch_netem kvaser_pci ftdi_sio vhci_hcd"
[ -e "$cache/$version/initrd.cpio" ] && [ "$(cat "$cache/$version/modules" 2>/dev/null)" = "$modules" ] && exit 0

mkdir -p "$cache"
work=$(mktemp -d "$cache/work.XXXXXX")
(cd "$work" && apt-get -qq -o APT::Sandbox::User=root download "$package")
dpkg-deb --fsys-tarfile "$work"/*.deb | tar -x -C "$work" --wildcards './boot/vmlinuz-*' '*lib/modules/*'
[ -d "$work/lib" ] || ln -s usr/lib "$work/lib"
PATH=$PATH:/usr/sbin:/sbin
depmod -b "$work" "$version"

mkdir "$work/out"
python3 - "$work/boot/vmlinuz-$version" "$work/out/vmlinux" <<'PYTHON'
# The uncompressed ELF file boots by PVH, so the emulated machine need not decompress it.
import subprocess
import sys

image = open(sys.argv[1], "rb").read()
for magic, command in ((b"\xfd7zXZ\0", ["xz", "-dc", "--single-stream"]), (b"\x28\xb5\x2f\xfd", ["zstd", "-dc"])):
    at = image.find(magic)
    while at >= 0:
        done = subprocess.run(command, input=image[at:], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        if done.stdout[:4] == b"\x7fELF" and len(done.stdout) > 1 << 20:
            open(sys.argv[2], "wb").write(done.stdout)
            sys.exit()
        at = image.find(magic, at + 1)
sys.exit("setup.sh: no vmlinux in " + sys.argv[1])
PYTHON

root=$work/root
mkdir -p "$root/bin" "$root/proc" "$root/sys" "$root/dev" "$root/modules" "$root/new"
cp "$(command -v busybox)" "$root/bin/busybox"
: >"$root/modules/order"
for module in $modules; do
    modprobe -d "$work" -S "$version" --show-depends "$module" | while read -r word file _; do
        [ "$word" = insmod ] || continue
        name=$(basename "$file" .xz)
        [ -e "$root/modules/$name" ] && continue
        case $file in
            *.xz) xz -dc "$file" >"$root/modules/$name" ;;
            *) cp "$file" "$root/modules/$name" ;;
        esac
        echo "$name" >>"$root/modules/order"
    done
done
cat >"$root/init" <<'INIT'
#!/bin/busybox sh
b=/bin/busybox
$b mount -t proc proc /proc
$b mount -t sysfs sys /sys
$b mount -t devtmpfs dev /dev
while read -r m; do $b insmod "/modules/$m" || echo "insmod $m: failed"; done </modules/order
$b mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000,ro,cache=loose root /new || $b poweroff -f
for d in proc sys dev; do $b mount -o move /$d /new/$d; done
exec $b switch_root /new "$GUEST_INIT"
INIT
chmod +x "$root/init"
(cd "$root" && find . | cpio -o -H newc --quiet) >"$work/out/initrd.cpio"
echo "$modules" >"$work/out/modules"
rm -rf "${cache:?}/$version"
mv "$work/out" "$cache/$version"
