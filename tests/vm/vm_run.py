"""Run a command under a Linux kernel that has vcan: this one if it has, else User Mode Linux, else QEMU.

    tests/vm/run [--backend auto|native|uml|qemu] [--timeout S] [--rw DIR]... -- COMMAND...
    tests/vm/run --which            which of them `auto` takes, or none

Prints what COMMAND prints, stdout and stderr apart, and exits with its exit code; 124: time-out; 125: the VM failed.
COMMAND finds the programs of .venv first. `make test` sets up .venv and a virtual machine.

native  COMMAND itself. Without the right to make interfaces: in a network namespace of its own, by `unshare` or `sudo`.
uml     User Mode Linux, 2 s to boot, Python at full speed. vcan, CAN FD, vxcan, gateway, BCM, J1939, slcan, tbf, netem.
        It has a time of its own (uml_time.c; needs a C compiler): what happens in there does not depend on how fast or busy
        the machine is, and to wait takes no time. Only --timeout is the machine's.
qemu    Emulated, Python 15 times slower. The same and ISO-TP; two kvaser_pci controllers on one bus (can0, can1);
        a 16550A UART (/dev/ttyS1, its other end /dev/virtio-ports/com1). USB devices played by the command itself can be
        plugged in by vhci_hcd (driver ftdi_sio). Its time is the instructions that it has executed, 2 ns each.

A VM sees the host's file system read-only at the same paths, with an empty /tmp, /var/tmp, /run and /dev/shm; each
--rw DIR is writable. It is root in there, lo is up, the CAN modules are loaded, and there is no vcan interface yet.
Of the environment it gets PATH, HOME, LANG, CI, VIRTUAL_ENV and what starts with KCG_, PYTHON, PYTEST_, HYPOTHESIS_
or COVERAGE_. Python finds no asammdf in there, which python-can imports where it is installed, and with it numpy and pandas:
4 s of each process in UML, a minute in QEMU.

Kept in mind in here: UML does not save the AVX-512 registers over a signal, so glibc and OpenSSL are told to leave
them alone, and number crunchers with a dispatcher of their own, as numpy, must stay outside. /dev/kvm may be there
and not work: QEMU always emulates. SIGKILL leaves UML's children behind: SIGTERM comes first.
"""

import argparse
import contextlib
import glob
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import BinaryIO, NoReturn

HERE = os.path.dirname(os.path.abspath(__file__))
PROJECT = os.path.dirname(os.path.dirname(HERE))
BACKENDS = ("native", "uml", "qemu")
TIMED_OUT = 124
VM_FAILED = 125

PASSED_ON = re.compile(
    r"(PATH|HOME|LANG|LC_ALL|CI|VIRTUAL_ENV)$|KCG_|PYTHON|PYTEST_|HYPOTHESIS_|COVERAGE_"
)
TMPFS = ("/tmp", "/var/tmp", "/run", "/dev/shm")  # guest-init.sh mounts an empty one on each

UML_MEMORY_MIB = 512
QEMU_MEMORY_MIB = 1024

GLIBC_WITHOUT_AVX512 = "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512BW"
# CPUID leaf 7, EBX: the bits of AVX512 F, DQ, IFMA, PF, ER, CD, BW, VL
OPENSSL_WITHOUT_AVX512 = ":~0xdc230000"


def passed_on() -> dict[str, str]:
    """The variables that COMMAND gets where it does not simply inherit them."""
    return {name: value for name, value in os.environ.items() if PASSED_ON.match(name)}


SET_UP = "`make test` sets up .venv and a kernel with vcan."


def is_in_venv() -> bool:
    """Whether this Python is a virtual environment's, which has the project and its test tools."""
    return sys.prefix != sys.base_prefix


def extend_path() -> None:
    """Puts the virtual environment's programs first in PATH, and the folders of `ip` and `tc` last."""
    folders = [os.path.join(sys.prefix, "bin")] if is_in_venv() else []
    folders += os.environ.get("PATH", "").split(os.pathsep)
    folders += ["/usr/sbin", "/usr/bin", "/sbin", "/bin"]
    os.environ["PATH"] = os.pathsep.join(filter(None, dict.fromkeys(folders)))


# --- this kernel


def native_prefix() -> list[str] | None:
    """What to put before a command so that it can make vcan interfaces here ([] if nothing); None if it cannot."""
    try:
        # AF_CAN, CAN_RAW, also where Python was built without them
        socket.socket(29, socket.SOCK_RAW, 1).close()
    except OSError:
        return None
    with_lo = ["sh", "-c", 'ip link set lo up && exec "$@"', "sh"]
    namespace = ["unshare", "--user", "--map-root-user", "--net", *with_lo]
    rights = "--inh-caps=+net_admin,+net_raw --ambient-caps=+net_admin,+net_raw"
    ids = f"--reuid={os.getuid()} --regid={os.getgid()} --init-groups"
    as_root = f"sudo -n unshare --net setpriv {ids} {rights} env".split()
    as_root += [f"{name}={value}" for name, value in passed_on().items()] + with_lo
    interface = f"vm{os.getpid()}"
    probe = ["sh", "-c", f"ip link add dev {interface} type vcan && ip link del {interface}"]
    for prefix in ([], namespace, as_root):
        with contextlib.suppress(OSError):
            done = subprocess.run(
                prefix + probe, check=False, stdin=subprocess.DEVNULL, capture_output=True
            )
            if done.returncode == 0:
                return prefix
    return None


# --- the two kinds of VM


def uml_command(job: str, out: int, err: int) -> list[str]:
    return f"""
        linux.uml mem={UML_MEMORY_MIB}M root=/dev/root rootfstype=hostfs rootflags=/ ro
        init={job}/guest-init.sh VM_JOB={job} VM_BACKEND=uml GLIBC_TUNABLES={GLIBC_WITHOUT_AVX512}
        con=null ssl=null ssl0=null,fd:{out} ssl1=null,fd:{err}
        uml_dir={job} umid=uml noreboot quiet loglevel=3
    """.split()


def uml_host_environment(job: str) -> dict[str, str]:
    """Its own, outside of the guest; uml_xstate.so is there where it does not start without."""
    own_time = os.path.join(job, "time.so")
    help_to_start = os.path.join(cache(), "uml_xstate.so")
    source = os.path.join(HERE, "uml_time.c")
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", own_time, source, "-ldl"], check=True)
    preload = filter(os.path.exists, (own_time, help_to_start))
    return {"TMPDIR": uml_memory_folder(job), "LD_PRELOAD": ":".join(preload)}


def uml_memory_folder(job: str) -> str:
    """Where UML keeps its memory file: /dev/shm if it has the room and allows to execute, as in a container it may not."""
    with contextlib.suppress(OSError):
        shm = os.statvfs("/dev/shm")
        room = shm.f_bavail * shm.f_frsize >= (UML_MEMORY_MIB + 32) << 20
        if room and not shm.f_flag & os.ST_NOEXEC and os.access("/dev/shm", os.W_OK):
            return "/dev/shm"
    return job


def cache() -> str:
    """What setup.sh has made."""
    return os.environ.get("VM_CACHE") or os.path.join(HERE, ".cache")


def qemu_kernel() -> str | None:
    """The newest kernel that setup.sh has unpacked."""
    kernels = glob.glob(os.path.join(cache(), "*", "vmlinux"))
    return max(kernels, key=os.path.getmtime, default=None)


def qemu_command(job: str, out: int, err: int) -> list[str]:
    kernel = qemu_kernel()
    if kernel is None:
        raise OSError("no kernel unpacked: run tests/vm/setup.sh qemu")
    append = f"""
        console=ttyS0 panic=-1 quiet loglevel=3 tsc=reliable no_timer_check mitigations=off nokaslr
        random.trust_cpu=on VM_BACKEND=qemu GUEST_INIT={job}/guest-init.sh
    """
    initrd = os.path.join(os.path.dirname(kernel), "initrd.cpio")
    command = f"""
        qemu-system-x86_64 -nodefaults -no-user-config -display none -no-reboot
        -machine q35 -accel tcg,thread=single,tb-size=512 -icount shift=1,sleep=off -cpu max -m {QEMU_MEMORY_MIB}
        -serial file:{job}/klog -device virtio-serial-pci
        -object can-bus,id=canbus0
        -device kvaser_pci,canbus=canbus0 -device kvaser_pci,canbus=canbus0
    """.split()
    command += ["-kernel", kernel, "-initrd", initrd, "-append", " ".join(append.split())]

    def port(name: str, chardev: str) -> list[str]:
        device = f"virtserialport,chardev={name},name={name}"
        return ["-chardev", f"{chardev},id={name}", "-device", device]

    for name, fd in (("stdout", out), ("stderr", err)):
        command += ["-add-fd", f"fd={fd},set={fd}"]
        command += port(name, f"file,path=/dev/fdset/{fd},append=on")
    for tag, path, options in (
        ("root", "/", ",readonly=on,multidevs=remap"),
        ("host", "/", ",multidevs=remap"),
        ("job", job, ""),
    ):
        command += ["-fsdev", f"local,id={tag},path={path},security_model=none{options}"]
        command += ["-device", f"virtio-9p-pci,fsdev={tag},mount_tag={tag}"]

    # One end is the device that the guest's driver sees, the other a virtio port that a test plays the device with.
    command += ["-chardev", f"socket,id=com1s,path={job}/com1,server=on,wait=off"]
    command += ["-device", "isa-serial,chardev=com1s,index=1"]
    return command + port("com1", f"socket,path={job}/com1")


# --- one run in a VM


def under_tmpfs(folder: str) -> bool:
    return any(folder == tmpfs or folder.startswith(tmpfs + "/") for tmpfs in TMPFS)


def write_job(job: str, backend: str, command: Sequence[str], writable: Sequence[str]) -> None:
    """Fills the job folder: what the guest runs and which of the host's folders it mounts."""
    without = os.path.join(job, "without")
    os.mkdir(without)
    with open(os.path.join(without, "asammdf.py"), "w") as file:
        file.write('raise ImportError("kept out of virtual machines by tests/vm/vm_run.py")\n')
    path = os.pathsep.join(filter(None, ("/run/job/without", os.environ.get("PYTHONPATH"))))
    environment = passed_on() | {
        "VM_BACKEND": backend,
        "TMPDIR": "/tmp",
        "NO_COLOR": "1",
        "PYTHONPATH": path,
    }
    environment["PYTHONDONTWRITEBYTECODE"] = "1"
    if backend == "uml":
        environment["GLIBC_TUNABLES"] = GLIBC_WITHOUT_AVX512
        environment["OPENSSL_ia32cap"] = OPENSSL_WITHOUT_AVX512
    lines = [f"export {name}={shlex.quote(value)}" for name, value in environment.items()]
    lines += [
        "echo >/run/job/started",
        f"cd {shlex.quote(os.getcwd())} && exec {shlex.join(command)}",
    ]
    # Where the project or Python is in a folder that the guest hides under a tmpfs, it is mounted there again.
    needed = {
        os.getcwd(),
        PROJECT,
        sys.prefix,
        sys.base_prefix,
        os.path.dirname(os.path.abspath(command[0])),
    }
    hidden = sorted(folder for folder in needed if under_tmpfs(folder) and folder not in TMPFS)
    for name, content in (("job.sh", lines), ("ro", hidden), ("rw", writable)):
        with open(os.path.join(job, name), "w") as file:
            file.writelines(line + "\n" for line in content)
    # A copy: the kernel's command line cannot carry a path with a blank.
    shutil.copy(os.path.join(HERE, "guest-init.sh"), job)


def pump(fd: int, to: BinaryIO) -> None:
    """Passes all that comes from the guest; goes on reading, so that the guest ends, when nobody wants it any more."""
    with open(fd, "rb", buffering=0) as pipe:
        while data := pipe.read(65536):
            with contextlib.suppress(OSError):
                to.write(data)
                to.flush()


UNDERTAKER = """
cat >/dev/null
kill -TERM -$0 && sleep 1 && kill -KILL -$0
rm -rf "$1"
"""
"""A shell that outlives this process, however that ends: then what is left of the VM's processes, and its job folder, go."""


def leave(number: int, _frame: FrameType | None) -> NoReturn:
    sys.exit(128 + number)


def start_vm(
    backend: str, job: str, out: int, err: int, log: BinaryIO
) -> "subprocess.Popen[bytes]":
    if backend == "uml":
        command = uml_command(job, out, err)
        environment = uml_host_environment(job)
    else:
        command = qemu_command(job, out, err)
        environment = {"TMPDIR": job}
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        pass_fds=(out, err),
        start_new_session=True,
        env={**os.environ, **environment},
    )


def run_in_vm(
    backend: str, command: Sequence[str], writable: Sequence[str], timeout_s: float
) -> tuple[int, bool]:
    """Returns the exit code, and whether the command was started at all."""
    job = tempfile.mkdtemp(prefix="vm.", dir="/var/tmp")
    undertaker = None
    result = Path(job, "rc")
    started = Path(job, "started")
    try:
        write_job(job, backend, command, writable)
        pipes = [os.pipe() for _ in range(2)]
        try:
            with open(os.path.join(job, "log"), "wb") as log:
                process = start_vm(backend, job, pipes[0][1], pipes[1][1], log)
        finally:
            for _, end in pipes:
                os.close(end)
        undertaker = subprocess.Popen(
            ["sh", "-c", UNDERTAKER, str(process.pid), job],
            stdin=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        pumps = [
            threading.Thread(target=pump, args=(end, to.buffer), daemon=True)
            for (end, _), to in zip(pipes, (sys.stdout, sys.stderr), strict=True)
        ]
        for thread in pumps:
            thread.start()
        try:
            process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            print(f"vm/run: {backend}: no end within {timeout_s:g} s", file=sys.stderr)
            return TIMED_OUT, True
        for thread in pumps:
            thread.join(60)
        if result.exists() and result.read_text().strip():
            return int(result.read_text()), True
        print(f"vm/run: {backend}: the VM ended without a result", file=sys.stderr)
        for file in map(Path, (f"{job}/log", f"{job}/klog")):
            if file.exists():
                print(file.read_text(errors="replace")[-4000:], file=sys.stderr)
        return VM_FAILED, started.exists()
    except (OSError, subprocess.CalledProcessError) as error:
        print(f"vm/run: {backend}: {error}", file=sys.stderr)
        return VM_FAILED, False
    finally:
        if undertaker is None:
            shutil.rmtree(job, ignore_errors=True)
        else:
            undertaker.communicate()


# --- the command line


def installed() -> list[str]:
    """The kinds of VM that can be tried, the better one first."""
    if not os.path.exists("/usr/bin/busybox"):
        return []
    vms = ["uml"] if shutil.which("linux.uml") and shutil.which("cc") else []
    return vms + (["qemu"] if qemu_kernel() and shutil.which("qemu-system-x86_64") else [])


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(usage=__doc__, add_help=True)
    parser.add_argument("--backend", choices=("auto", *BACKENDS), default="auto")
    parser.add_argument("--timeout", type=float, default=600.0)
    parser.add_argument("--rw", action="append", default=[])
    parser.add_argument("--which", action="store_true")
    parser.add_argument("command", nargs="*")
    args = parser.parse_args()
    args.rw = [os.path.realpath(folder) for folder in args.rw]
    for folder in args.rw:
        if not os.path.isdir(folder):
            parser.error(f"--rw {folder}: no such folder")
    if not args.command and not args.which:
        parser.error("COMMAND is missing")
    return args


def main() -> int:
    args = arguments()
    extend_path()
    prefix = None
    if args.backend in ("auto", "native"):
        prefix = native_prefix()
        if prefix is None and args.backend == "native" and not args.which:
            print(
                "vm/run: native: this kernel has no vcan, or this user may not make one. "
                "Use a virtual machine: --backend auto.",
                file=sys.stderr,
            )
            return VM_FAILED
    vms = installed() if args.backend == "auto" else [args.backend]
    if args.which:
        names = ["native"] if prefix is not None else [vm for vm in vms if vm in installed()]
        print(names[0] if names else "none")
        return 0 if names else 1
    if not is_in_venv():
        print(f"vm/run: {sys.executable} is not the project's .venv. {SET_UP}", file=sys.stderr)
    if prefix is not None:
        return run_native([*prefix, *args.command], args.timeout)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, leave)
    for vm in vms:
        code, started = run_in_vm(vm, args.command, args.rw, args.timeout)
        if code != VM_FAILED or started:
            return code
    missing = ", and none of its virtual machines starts" if vms else " and no virtual machine"
    print(f"vm/run: this kernel has no vcan{missing}. {SET_UP}", file=sys.stderr)
    return VM_FAILED


def run_native(command: Sequence[str], timeout_s: float) -> int:
    """Becomes the command; `timeout` keeps the time."""
    sys.stdout.flush()
    limited = ["timeout", "--foreground", "--kill-after=10", f"{timeout_s:g}", *command]
    try:
        os.execvp(limited[0], limited)
    except OSError as error:
        print(f"vm/run: {limited[0]}: {error}", file=sys.stderr)
        return 127


if __name__ == "__main__":
    sys.exit(main())
