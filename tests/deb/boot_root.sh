#!/bin/sh
# in_fresh_roots.py runs this as root in a User Mode Linux. It boots the systemd of a Debian root,
# optionally read-only with /var in memory. At the end of the boot it runs SCRIPT of the output
# folder in the root.
#   boot_root.sh ROOT OUTPUT-FOLDER SCRIPT [ro]
set -eu
root=$1 out=$2 script=$3
ip link add vcan0 type vcan
ip link set vcan0 up

mount --rbind "$root" "$root"
if [ "${4:-}" = ro ]; then
    mount -o remount,bind,ro "$root"
    mount -t tmpfs -o mode=755 tmpfs "$root/var"
fi
for folder in run tmp; do mount -t tmpfs -o mode=755 tmpfs "$root/$folder"; done
mkdir -p "$root/var/log/journal" "$root/var/lib" "$root/var/tmp"
mount --bind "$out" "$root/media"
for folder in dev sys; do mount --rbind /$folder "$root/$folder"; done
mount -t cgroup2 cgroup2 "$root/sys/fs/cgroup"

units=$root/run/systemd/system
mkdir -p "$units/multi-user.target.wants"
cat >"$units/trial.service" <<X
[Unit]
After=kontronik-can-gw.service
[Service]
Type=oneshot
ExecStart=/usr/bin/python3 -B /media/$script
StandardOutput=file:/media/said
StandardError=inherit
ExecStopPost=/bin/systemctl exit
TimeoutStartSec=480
X
cat >"$units/simulator.service" <<X
[Unit]
Before=kontronik-can-gw.service
[Service]
ExecStart=/usr/bin/kontronik-can-gw simulate --link /run/esc1
ExecStartPost=/bin/sh -c 'until [ -e /run/esc1 ]; do sleep 0.1; done; chown root:dialout /run/esc1; chmod 660 /run/esc1'
X
for unit in trial simulator; do ln -s ../$unit.service "$units/multi-user.target.wants/$unit.service"; done
# units for features that User Mode Linux or this root lacks
for unit in dev-hugepages.mount dev-mqueue.mount systemd-remount-fs.service sys-kernel-debug.mount \
    sys-kernel-tracing.mount sys-kernel-config.mount sys-fs-fuse-connections.mount \
    systemd-firstboot.service systemd-machine-id-commit.service getty.target \
    systemd-logind.service systemd-networkd.service systemd-timesyncd.service tmp.mount; do
    ln -s /dev/null "$units/$unit"
done
exec env container=other unshare --pid --fork --mount --kill-child sh -c '
    mount -t proc proc "$1/proc"
    cd "$1"
    pivot_root . mnt
    exec chroot . /lib/systemd/systemd --system --unit=multi-user.target --log-target=console --show-status=no </dev/null' sh "$root"
