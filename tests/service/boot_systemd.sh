#!/bin/sh
# test_under_systemd.py runs this as root in a User Mode Linux, whose root is this machine's and
# read-only. It makes /etc and /var writable for the VM alone, and starts systemd as process 1 of a
# separate process space. systemd runs inside_systemd.py and ends.
#   boot_systemd.sh PYTHON SCRIPT OUTPUT-FOLDER FOLDER...
# The unprivileged service needs each FOLDER, but cannot reach it because a folder above it is closed
# to other users.
set -eu
python=$1 script=$2 out=$3
shift 3

mkdir -p /run/etc /run/kept
cp -a /etc/. /run/etc/ 2>/dev/null || true
mount --bind /run/etc /etc
number=0
for folder; do
    number=$((number + 1))
    mkdir -p "/run/kept/$number"
    mount --bind "$folder" "/run/kept/$number"
done
number=0
for folder; do
    number=$((number + 1))
    top=/$(echo "$folder" | cut -d/ -f2)
    mountpoint -q "$top" || mount -t tmpfs -o mode=755 tmpfs "$top"
    mkdir -p "$folder"
    mount --move "/run/kept/$number" "$folder"
done
# Each "systemctl daemon-reload" would run the machine's generators again, a dozen processes that are
# not needed here.
for folder in /var/lib /var/log /var/cache /usr/lib/systemd/system-generators; do mount -t tmpfs tmpfs "$folder"; done
mount -t cgroup2 cgroup2 /sys/fs/cgroup
echo 0123456789abcdef0123456789abcdef >/etc/machine-id

units=/run/systemd/system
mkdir -p $units
cat >$units/trial.target <<X
[Unit]
Requires=basic.target
Wants=trial.service
After=basic.target
AllowIsolate=yes
X
cat >$units/trial.service <<X
[Unit]
After=basic.target systemd-journald.service
[Service]
Type=oneshot
ExecStart=$python -B $script $out
StandardOutput=file:$out/said
StandardError=inherit
ExecStopPost=/bin/systemctl exit
TimeoutStartSec=480
X
# units for features that this machine's file system or kernel lacks
for unit in dev-hugepages.mount dev-mqueue.mount systemd-remount-fs.service sys-kernel-debug.mount \
    sys-kernel-tracing.mount sys-kernel-config.mount sys-fs-fuse-connections.mount \
    systemd-firstboot.service systemd-machine-id-commit.service; do
    ln -s /dev/null $units/$unit
done
container=other exec unshare --pid --fork --mount --mount-proc --kill-child \
    /lib/systemd/systemd --system --unit=trial.target --log-target=console --show-status=no </dev/null
