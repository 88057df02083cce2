/* The bus: a real CAN interface, "can:vcan0", or a local socket that keeps frames apart and stands for it, "unix:NAME". */
#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

static void die(const char *what)
{
    fprintf(stderr, "%s: %s\n", what, strerror(errno));
    exit(1);
}

static int can_socket(const char *name)
{
    int fd = socket(AF_CAN, SOCK_RAW, CAN_RAW);
    struct ifreq request = {0};
    struct sockaddr_can address = {.can_family = AF_CAN};
    if (fd < 0)
        die("CAN socket");
    strncpy(request.ifr_name, name, IFNAMSIZ - 1);
    if (ioctl(fd, SIOCGIFINDEX, &request) < 0)
        die(name);
    address.can_ifindex = request.ifr_ifindex;
    if (bind(fd, (struct sockaddr *)&address, sizeof address) < 0)
        die(name);
    return fd;
}

/* A name in the abstract space: no file is left behind. */
static socklen_t local_address(struct sockaddr_un *address, const char *name)
{
    memset(address, 0, sizeof *address);
    address->sun_family = AF_UNIX;
    strncpy(address->sun_path + 1, name, sizeof address->sun_path - 2);
    return offsetof(struct sockaddr_un, sun_path) + 1 + strlen(name);
}
