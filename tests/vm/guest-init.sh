# Process 1 of both kinds of VM. vm_run.py copies it to the job folder, with a first line that names
# busybox there. The root is the host's / and read-only. VM_BACKEND and VM_JOB are set on the kernel's
# command line. /run/job is the host's job folder with busybox, job.sh (the script to run), modules
# (UML's modules), ro and rw (folders to mount), and rc (the result).
b=${0%/*}/busybox

if [ "$VM_BACKEND" = uml ]; then
    $b mount -t proc proc /proc
    $b mount -t sysfs sys /sys
fi
$b mkdir -p /dev/pts /dev/shm
$b mount -t devpts -o ptmxmode=666 devpts /dev/pts
$b ln -sf /proc/self/fd /dev/fd
$b mount -t tmpfs tmpfs /run
$b mkdir -p /run/job

if [ "$VM_BACKEND" = uml ]; then
    $b mount -t hostfs -o "$VM_JOB" hostfs /run/job
    # Modules are not loaded automatically. Load all that may be needed, in order of dependency. Their
    # folder may be below /tmp.
    read -r modules </run/job/modules
    modules=$modules/$($b uname -r)
    names="can can-raw can-bcm can-gw can-isotp can-j1939 can-dev vcan vxcan slcan sch_tbf sch_netem"
    files=$($b grep -oE "^[^:]*/($(echo $names | $b tr ' ' '|'))\.ko[^:]*" "$modules/modules.dep")
    for m in $names; do
        for f in $files; do
            case $f in
                */$m.ko) f=$modules/$f ;;
                */$m.ko.xz) $b xzcat "$modules/$f" >/run/$m.ko && f=/run/$m.ko ;;
                *) continue ;;
            esac
            $b insmod "$f" || echo "insmod $m: failed"
        done
    done
    bind() { $b mkdir -p "$2" && $b mount -t hostfs -o "$1,$2" hostfs "$2"; }
    for t in 0 1; do $b stty -F /dev/ttyS$t raw; done
    out=/dev/ttyS0 err=/dev/ttyS1
else
    options=trans=virtio,version=9p2000.L,msize=512000
    $b mount -t 9p -o $options,cache=none job /run/job
    $b mkdir -p /run/host
    $b mount -t 9p -o $options,cache=mmap host /run/host
    bind() { $b mkdir -p "$2" && $b mount -o bind "/run/host$2" "$2" && $b mount -o "remount,bind,$1" "$2"; }
    $b mkdir /dev/virtio-ports
    for p in /sys/class/virtio-ports/*; do
        read -r name <"$p/name"
        $b ln -s "/dev/${p##*/}" "/dev/virtio-ports/$name"
    done
    out=/dev/virtio-ports/stdout err=/dev/virtio-ports/stderr
fi
b=/run/job/busybox # the next line hides the job folder in /var/tmp
for d in /dev/shm /tmp /var/tmp; do $b mount -t tmpfs tmpfs $d; done
while read -r d; do bind ro "$d" || echo "mount $d: failed"; done </run/job/ro
while read -r d; do bind rw "$d" || echo "mount $d: failed"; done </run/job/rw

$b ip link set lo up
$b hostname vm
$b mkfifo /run/stdout /run/stderr
$b cat /run/stdout >$out &
$b cat /run/stderr >$err &
/bin/sh /run/job/job.sh </dev/null >/run/stdout 2>/run/stderr
echo $? >/run/job/rc
wait
$b poweroff -f
