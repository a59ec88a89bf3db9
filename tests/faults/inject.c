/* Makes the n-th change of a file below a directory fail, for the fault tests. Preloaded into the real
 * binary; driven through a file that both sides map:
 *   [0] calls left before the fault (0: disarmed)  [1] errno, or -1: abort  [2] number of calls after it that fail as well
 *   [3] faults given                               [4] calls seen while armed
 *   [5] seconds by which the clock of the day is ahead
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

static int64_t *plan;
static const char *directory;

__attribute__((constructor)) static void begin(void) {
    const char *path = getenv("VPD_FAULTS");
    directory = getenv("VPD_FAULTS_DIR");
    int fd = path ? open(path, O_RDWR) : -1;
    if (fd < 0) return;
    void *map = mmap(NULL, 6 * sizeof(int64_t), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    if (map != MAP_FAILED) plan = map;
}

static int ours(const char *path) {
    return path && directory && strncmp(path, directory, strlen(directory)) == 0;
}

/* Whether the call fails now. */
static int fails(void) {
    __atomic_add_fetch(&plan[4], 1, __ATOMIC_SEQ_CST);
    int64_t left = __atomic_sub_fetch(&plan[0], 1, __ATOMIC_SEQ_CST);
    if (left > 0) return 0;
    if (left < 0) {
        __atomic_store_n(&plan[0], 0, __ATOMIC_SEQ_CST);
        return 0;
    }
    if (plan[2] > 0) {
        __atomic_sub_fetch(&plan[2], 1, __ATOMIC_SEQ_CST);
        __atomic_store_n(&plan[0], 1, __ATOMIC_SEQ_CST);
    } else {
        __atomic_store_n(&plan[0], 0, __ATOMIC_SEQ_CST);
    }
    __atomic_add_fetch(&plan[3], 1, __ATOMIC_SEQ_CST);
    if (plan[1] < 0) abort();
    errno = (int)plan[1];
    return 1;
}

static int armed(void) { return plan && __atomic_load_n(&plan[0], __ATOMIC_SEQ_CST) > 0; }

static int fails_path(const char *path) { return armed() && ours(path) && fails(); }

static int fails_fd(int fd) {
    char link[64], path[4096];
    if (!armed()) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0) return 0;
    path[length] = 0;
    return ours(path) && fails();
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

ssize_t write(int fd, const void *data, size_t size) {
    return fails_fd(fd) ? -1 : REAL(write)(fd, data, size);
}
ssize_t writev(int fd, const struct iovec *parts, int count) {
    return fails_fd(fd) ? -1 : REAL(writev)(fd, parts, count);
}
int fsync(int fd) { return fails_fd(fd) ? -1 : REAL(fsync)(fd); }
int fdatasync(int fd) { return fails_fd(fd) ? -1 : REAL(fdatasync)(fd); }
int ftruncate64(int fd, off64_t size) { return fails_fd(fd) ? -1 : REAL(ftruncate64)(fd, size); }
int rename(const char *from, const char *to) { return fails_path(to) ? -1 : REAL(rename)(from, to); }
int link(const char *from, const char *to) { return fails_path(to) ? -1 : REAL(link)(from, to); }
int linkat(int a, const char *from, int b, const char *to, int flags) {
    return fails_path(to) ? -1 : REAL(linkat)(a, from, b, to, flags);
}
int mkdir(const char *path, mode_t mode) { return fails_path(path) ? -1 : REAL(mkdir)(path, mode); }

int clock_gettime(clockid_t clock, struct timespec *time) {
    int failed = (int)syscall(SYS_clock_gettime, clock, time);
    if (!failed && clock == CLOCK_REALTIME && plan) time->tv_sec += __atomic_load_n(&plan[5], __ATOMIC_SEQ_CST);
    return failed;
}

int open64(const char *path, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    mode_t mode = flags & O_CREAT ? va_arg(rest, mode_t) : 0;
    va_end(rest);
    return flags & O_CREAT && fails_path(path) ? -1 : REAL(open64)(path, flags, mode);
}
