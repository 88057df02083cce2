#!/bin/sh
# Run by test_under_systemd.py as root in a User Mode Linux whose root is this machine's, read-only: makes /etc and /var
# writable (for the VM alone), and starts systemd as process 1 of a process space of its own. It runs inside_systemd.py
# and ends.
#   boot_systemd.sh PYTHON SCRIPT OUTPUT-FOLDER FOLDER...
# FOLDER: what the unprivileged service must see and cannot, because a folder above it is closed to others.
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
# each "systemctl daemon-reload" would run the machine's generators anew, a dozen processes of which nothing is needed here
for folder in /var/lib /var/log /usr/lib/systemd/system-generators; do mount -t tmpfs tmpfs "$folder"; done
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
# what this machine's file system or kernel does not have
for unit in dev-hugepages.mount dev-mqueue.mount systemd-remount-fs.service sys-kernel-debug.mount sys-kernel-tracing.mount \
    sys-kernel-config.mount sys-fs-fuse-connections.mount systemd-firstboot.service systemd-machine-id-commit.service; do
    ln -s /dev/null $units/$unit
done
container=other exec unshare --pid --fork --mount --mount-proc --kill-child \
    /lib/systemd/systemd --system --unit=trial.target --log-target=console --show-status=no </dev/null
