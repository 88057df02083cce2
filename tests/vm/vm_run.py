"""Run a command under a Linux kernel that has vcan: this one, User Mode Linux or QEMU.

    tests/vm/run [--backend auto|native|uml|qemu] [--timeout S] [--rw DIR]... -- COMMAND...
    tests/vm/run --which            prints the backend that `auto` chooses, or none

Prints the output of COMMAND, with stdout and stderr separate, and exits with its exit code. The
exit code is 124 after a timeout, and 125 if the VM failed. COMMAND finds the programs of .venv
first. `make test` sets up .venv and a virtual machine.

native  COMMAND itself. If it may not create interfaces, it runs in a separate network namespace, by
        `unshare` or `sudo`.
uml     User Mode Linux. It boots in 2 s and runs Python at full speed. It has vcan, CAN FD, vxcan,
        gateway, BCM, J1939, slcan, tbf and netem. Its time is virtual (uml_time.c, which needs a C
        compiler): the result does not depend on the speed or load of the machine, and waiting takes
        no time. Only --timeout is in the machine's time.
qemu    An emulated machine, in which Python is 15 times slower. It has the same features and
        ISO-TP, two kvaser_pci controllers on one bus (can0, can1), and a 16550A UART (/dev/ttyS1,
        with the other end at /dev/virtio-ports/com1). The command can simulate USB devices and plug
        them in by vhci_hcd (driver ftdi_sio). Its time is the number of executed instructions, 2 ns
        each.

In a VM the host's file system is read-only at the same paths, with an empty /tmp, /var/tmp, /run
and /dev/shm. Each --rw DIR is writable. COMMAND is root, lo is up, the CAN modules are loaded, and
no vcan interface exists yet. The environment has PATH, HOME, LANG, CI, VIRTUAL_ENV and variables
that begin with KCG_, PYTHON, PYTEST_, HYPOTHESIS_ or COVERAGE_. Python does not find asammdf.
python-can would import it if it is installed, and numpy and pandas with it, which would take 4 s of
each process in UML and a minute in QEMU.

Limits of the virtual machines: UML does not save the AVX-512 registers over a signal, so glibc and
OpenSSL are configured not to use them. Libraries that choose instructions themselves, such as
numpy, cannot be used. /dev/kvm may exist without working, so QEMU always emulates. SIGKILL leaves
UML's children behind, so SIGTERM is sent first.
"""

import argparse
import contextlib
import glob
import itertools
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
from collections.abc import Iterable, Iterator, Sequence
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

MOST_ON_A_CPU = 16
"""Most virtual machines of this computer that share a CPU."""
UML_MEMORY_MIB = 512
QEMU_MEMORY_MIB = 1024

GLIBC_WITHOUT_AVX512 = "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512BW"
OPENSSL_WITHOUT_AVX512 = ":~0xdc230000"
"""The bits of AVX512 F, DQ, IFMA, PF, ER, CD, BW and VL in EBX of CPUID leaf 7."""


def passed_on() -> dict[str, str]:
    """Return the variables that COMMAND gets if it does not simply inherit the environment."""
    return {name: value for name, value in os.environ.items() if PASSED_ON.match(name)}


SET_UP = "`make test` sets up .venv and a kernel with vcan."


def is_in_venv() -> bool:
    """Return whether this Python is in a virtual environment with the project and its tools."""
    return sys.prefix != sys.base_prefix


def extend_path() -> None:
    """Put the virtual environment's programs first in PATH, and the folders of `ip` last."""
    folders = [os.path.join(sys.prefix, "bin")] if is_in_venv() else []
    folders += os.environ.get("PATH", "").split(os.pathsep)
    folders += ["/usr/sbin", "/usr/bin", "/sbin", "/bin"]
    os.environ["PATH"] = os.pathsep.join(filter(None, dict.fromkeys(folders)))


# --- this kernel


def native_prefix() -> list[str] | None:
    """Return the prefix that a command needs to create vcan interfaces on this kernel.

    The list is empty if no prefix is needed. None if the command cannot create them.
    """
    try:
        # AF_CAN and CAN_RAW as numbers, because Python may be built without them
        socket.socket(29, socket.SOCK_RAW, 1).close()
    except OSError:
        return None
    with_lo = ["sh", "-c", 'ip link set lo up && exec "$@"', "sh"]
    namespace = ["unshare", "--user", "--map-root-user", "--net", *with_lo]
    rights = "--inh-caps=+net_admin,+net_raw --ambient-caps=+net_admin,+net_raw"
    ids = f"--reuid={os.getuid()} --regid={os.getgid()} --init-groups"
    as_root = f"sudo -n unshare --net setpriv {ids} {rights} env".split()
    as_root += [f"{name}={value}" for name, value in passed_on().items()]
    as_root += with_lo
    interface = f"vm{os.getpid()}"
    probe = ["sh", "-c", f"ip link add dev {interface} type vcan && ip link del {interface}"]
    for prefix in ([], namespace, as_root):
        with contextlib.suppress(OSError):
            done = subprocess.run(
                prefix + probe,
                check=False,
                stdin=subprocess.DEVNULL,
                capture_output=True,
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
    """Return UML's own environment, outside of the guest.

    uml_xstate.so exists only on machines on which UML does not start without it.
    """
    own_time = os.path.join(job, "time.so")
    help_to_start = os.path.join(cache(), "uml_xstate.so")
    source = os.path.join(HERE, "uml_time.c")
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", own_time, source, "-ldl"], check=True)
    preload = filter(os.path.exists, (own_time, help_to_start))
    return {"TMPDIR": uml_memory_folder(job), "LD_PRELOAD": ":".join(preload)}


def uml_modules() -> Path:
    """Return the folder of UML's modules. It is beside the program, which may be a link."""
    program = Path(shutil.which("linux.uml") or "/usr/bin/linux.uml").resolve()
    return program.parents[1] / "lib/uml/modules"


def uml_memory_folder(job: str) -> str:
    """Return the folder of UML's memory file.

    It is /dev/shm if that has enough room and allows execution, which a container may forbid.
    """
    with contextlib.suppress(OSError):
        shm = os.statvfs("/dev/shm")
        room = shm.f_bavail * shm.f_frsize >= (UML_MEMORY_MIB + 32) << 20
        if room and not shm.f_flag & os.ST_NOEXEC and os.access("/dev/shm", os.W_OK):
            return "/dev/shm"
    return job


def cache() -> str:
    """Return the folder with the results of setup.sh."""
    return os.environ.get("VM_CACHE") or os.path.join(HERE, ".cache")


def qemu_kernel() -> str | None:
    """Return the newest kernel that setup.sh has unpacked, or None."""
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
        -machine q35 -accel tcg,thread=single,tb-size=512 -icount shift=1,sleep=off
        -cpu max -m {QEMU_MEMORY_MIB}
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

    # One end is the device of the guest's driver. A test simulates the device at the other end,
    # which is a virtio port.
    command += ["-chardev", f"socket,id=com1s,path={job}/com1,server=on,wait=off"]
    command += ["-device", "isa-serial,chardev=com1s,index=1"]
    return command + port("com1", f"socket,path={job}/com1")


# --- one run in a VM


def under_tmpfs(folder: str) -> bool:
    return any(folder == tmpfs or folder.startswith(tmpfs + "/") for tmpfs in TMPFS)


def write_job(
    job: str,
    backend: str,
    command: Sequence[str],
    writable: Sequence[str],
) -> None:
    """Fill the job folder with the guest's script and the list of the host folders to mount."""
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
    # If the project or Python is in a folder that the guest hides under a tmpfs, it is mounted
    # there again.
    needed = {
        os.getcwd(),
        PROJECT,
        sys.prefix,
        sys.base_prefix,
        os.path.dirname(os.path.abspath(command[0])),
    }
    hidden = sorted(folder for folder in needed if under_tmpfs(folder) and folder not in TMPFS)
    modules = [str(uml_modules())]
    files = (("job.sh", lines), ("modules", modules), ("ro", hidden), ("rw", writable))
    for name, content in files:
        with open(os.path.join(job, name), "w") as file:
            file.writelines(line + "\n" for line in content)
    # The script is copied, because the kernel's command line cannot contain a path with a blank.
    shutil.copy(shutil.which("busybox") or "busybox", job)
    init = Path(job, "guest-init.sh")
    init.write_text(f"#!{job}/busybox sh\n{Path(HERE, 'guest-init.sh').read_text()}")
    init.chmod(0o755)


def pump(fd: int, to: BinaryIO) -> None:
    """Pass on the guest's output.

    Continue reading even if the output cannot be written, so that the guest can end.
    """
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
"""A shell that survives this process, even if that is killed.

It ends the VM's remaining processes and removes the job folder.
"""


def leave(number: int, _frame: FrameType | None) -> NoReturn:
    sys.exit(128 + number)


reserved: list[socket.socket] = []
"""The names of the CPUs that this process has reserved."""


@contextlib.contextmanager
def on_one_cpu() -> Iterator[None]:
    """Let this process and its new children run on one CPU only, during the block.

    User Mode Linux has several processes, and only one of them runs at a time. They take turns
    several times faster on one CPU than on two.
    """
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {reserved_cpu(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def reserved_cpu(cpus: Iterable[int]) -> int:
    """Return the CPU with the fewest virtual machines, and count one more until this process ends.

    Each is a name in the abstract namespace of sockets, so a killed process leaves nothing behind.
    """
    for place, cpu in itertools.product(range(MOST_ON_A_CPU), sorted(cpus)):
        name = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            name.bind(f"\0kontronik_can_gw vm {cpu} {place}")
        except OSError:  # taken by another virtual machine
            name.close()
            continue
        reserved.append(name)
        return cpu
    return min(cpus)


def start_vm(
    backend: str,
    job: str,
    out: int,
    err: int,
    log: BinaryIO,
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
    backend: str,
    command: Sequence[str],
    writable: Sequence[str],
    timeout_s: float,
) -> tuple[int, bool]:
    """Run a command in a VM. Return its exit code, and whether it was started at all."""
    job = tempfile.mkdtemp(prefix="vm.", dir="/var/tmp")
    undertaker = None
    result = Path(job, "rc")
    started = Path(job, "started")
    try:
        write_job(job, backend, command, writable)
        pipes = [os.pipe() for _ in range(2)]
        place = on_one_cpu() if backend == "uml" else contextlib.nullcontext()
        try:
            with open(os.path.join(job, "log"), "wb") as log, place:
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
    """Return the kinds of VM that can be tried, the better one first."""
    if not shutil.which("busybox"):
        return []
    vms = []
    if shutil.which("linux.uml") and shutil.which("cc"):
        vms.append("uml")
    if qemu_kernel() and shutil.which("qemu-system-x86_64"):
        vms.append("qemu")
    return vms


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
    """Replace this process by the command. `timeout` limits its time."""
    sys.stdout.flush()
    limited = ["timeout", "--foreground", "--kill-after=10", f"{timeout_s:g}", *command]
    try:
        os.execvp(limited[0], limited)
    except OSError as error:
        print(f"vm/run: {limited[0]}: {error}", file=sys.stderr)
        return 127


if __name__ == "__main__":
    sys.exit(main())
