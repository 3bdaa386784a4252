/* Counts the file operations of a run in the C library, and does something at one of them: ends the process, sends a signal, or lets the operation fail.

   Loaded with LD_PRELOAD. It is armed by the environment (trap.py has the names), in the constructor or by trap_arm() after a fork. Processes of one run
   share the counters in a file that is mapped into each of them: a child that a stage starts counts on.

   An operation belongs to the stage in whose folder, or work folder, its path lies; below the source to "source"; elsewhere in the run to "engine". */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { READ = 1, OPEN = 2, WRITE = 4, FSYNC = 8, RENAME = 16, MKDIR = 32, UNLINK = 64, RMDIR = 128 };
static const char *const NAMES[] = {"read", "open", "write", "fsync", "rename", "mkdir", "unlink", "rmdir"};

typedef struct {
    volatile int64_t seen;     /* operations of the kinds and the stage that are counted */
    volatile int64_t fired;    /* whether it came to the one that was meant */
    volatile int64_t failed;   /* operations that were let fail */
    char path[2048];           /* of the one that was meant */
} State;

static State *state;
static int armed, log_fd = -1;
static char run[PATH_MAX], source[PATH_MAX], stage[64], action[32];
static int kinds, fault_kinds, number, fault, lasting, deadly;
static __thread int inside;

static long to_number(const char *name, long otherwise) {
    const char *text = getenv(name);
    return text && *text ? strtol(text, NULL, 10) : otherwise;
}

static void to_text(const char *name, char *into, size_t size) {
    const char *text = getenv(name);
    snprintf(into, size, "%s", text ? text : "");
}

__attribute__((visibility("default"))) int trap_arm(void) {
    const char *place = getenv("TRAP_STATE"), *log = getenv("TRAP_LOG");
    armed = 0;
    if (!place || !*place) return 0;
    inside = 1;
    int fd = (int)syscall(SYS_openat, AT_FDCWD, place, O_RDWR | O_CLOEXEC);
    inside = 0;
    if (fd < 0) return 0;
    void *mapped = mmap(NULL, sizeof(State), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    syscall(SYS_close, fd);
    if (mapped == MAP_FAILED) return 0;
    state = mapped;
    log_fd = -1;
    if (log && *log) {
        fd = (int)syscall(SYS_openat, AT_FDCWD, log, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0600);
        log_fd = fd < 0 ? -1 : (int)syscall(SYS_fcntl, fd, F_DUPFD_CLOEXEC, 900);
        syscall(SYS_close, fd);
    }
    to_text("TRAP_RUN", run, sizeof run);
    to_text("TRAP_SOURCE", source, sizeof source);
    to_text("TRAP_STAGE", stage, sizeof stage);
    to_text("TRAP_ACTION", action, sizeof action);
    kinds = (int)to_number("TRAP_KINDS", 255);
    fault_kinds = (int)to_number("TRAP_FAULT_KINDS", 255);
    number = (int)to_number("TRAP_NUMBER", 0);
    fault = (int)to_number("TRAP_ERRNO", 0);
    lasting = (int)to_number("TRAP_LASTING", 0);
    deadly = (int)to_number("TRAP_DEADLY", 0);
    armed = 1;
    return 1;
}

__attribute__((constructor)) static void begin(void) { trap_arm(); }

/* Where a path lies: the rest of it behind a prefix, or NULL. */
static const char *below(const char *path, const char *prefix) {
    size_t length = strlen(prefix);
    if (!length || strncmp(path, prefix, length)) return NULL;
    if (path[length] == '/') return path + length + 1;
    return path[length] ? NULL : path + length;
}

static int absolute(int folder, const char *path, char *into, size_t size) {
    char link[64], base[PATH_MAX];
    if (path && path[0] == '/') return snprintf(into, size, "%s", path) > 0;
    if (folder == AT_FDCWD) {
        if (syscall(SYS_getcwd, base, sizeof base) < 0) return 0;
    } else {
        snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
        ssize_t length = syscall(SYS_readlinkat, AT_FDCWD, link, base, sizeof base - 1);
        if (length <= 0) return 0;
        base[length] = 0;
    }
    if (base[0] != '/') return 0;
    return path && *path ? snprintf(into, size, "%s/%s", base, path) > 0 : snprintf(into, size, "%s", base) > 0;
}

static void name_stage(const char *path, char *into, size_t size) {
    const char *rest = below(path, run);
    if (!rest) {
        snprintf(into, size, "source");
        return;
    }
    if (!strncmp(rest, ".work/", 6)) rest += 6;
    if (!strncmp(rest, "old-", 4)) rest += 4;
    size_t length = strcspn(rest, "/");
    if (rest[0] == '.' || !length || length >= size || memchr(rest, '-', length) || memchr(rest, '.', length)) {
        snprintf(into, size, "engine");
        return;
    }
    memcpy(into, rest, length);
    into[length] = 0;
}

static void act(void) {
    int value = atoi(strchr(action, ':') ? strchr(action, ':') + 1 : "9");
    pid_t leader = getpgrp();
    if (!strncmp(action, "leader", 6)) syscall(SYS_kill, leader, value); /* the process that the user started */
    else syscall(SYS_kill, -leader, value); /* all of the run, as a terminal does */
}

/* Called before each operation; returns the errno to fail with, or 0. Kind 0 is no operation that counts. */
static int meet(int kind, int folder, const char *name) {
    char path[2 * PATH_MAX], where[64];
    if (!armed || inside || !kind) return 0;
    int saved = errno, result = 0;
    inside = 1;
    if (absolute(folder, name, path, sizeof path) && (below(path, run) || (kind == READ && below(path, source)))) {
        name_stage(path, where, sizeof where);
        if (log_fd >= 0) {
            char line[2 * PATH_MAX + 128];
            int which = __builtin_ctz(kind);
            int length = snprintf(line, sizeof line, "%s\t%s\t%s\n", where, NAMES[which], path);
            syscall(SYS_write, log_fd, line, length);
        }
        int counted = (kind & kinds) && (!stage[0] || !strcmp(stage, where));
        int64_t count = counted ? __atomic_add_fetch(&state->seen, 1, __ATOMIC_SEQ_CST) : 0;
        if (number > 0 && counted && count == number) {
            snprintf(state->path, sizeof state->path, "%s\t%s\t%.1900s", where, NAMES[__builtin_ctz(kind)], path);
            __atomic_store_n(&state->fired, 1, __ATOMIC_SEQ_CST);
            if (action[0]) act();
            result = fault;
        } else if (fault && lasting && state->fired && (kind & fault_kinds)) {
            result = fault;
        }
        if (result && __atomic_add_fetch(&state->failed, 1, __ATOMIC_SEQ_CST) == deadly) syscall(SYS_kill, -getpgrp(), SIGKILL);
    }
    inside = 0;
    errno = saved;
    return result;
}

static int kind_of(int flags) {
    if (flags & O_DIRECTORY) return 0; /* to list it, or to sync it */
    return (flags & O_ACCMODE) == O_RDONLY ? READ : OPEN;
}

#define NEXT(type, name, parameters) \
    static type(*next) parameters; \
    if (!next) next = (type(*) parameters)dlsym(RTLD_NEXT, #name)
#define FAIL(kind, folder, path, value) \
    do { \
        int why = meet(kind, folder, path); \
        if (why) { \
            errno = why; \
            return value; \
        } \
    } while (0)

#define OPENS(name, parameters, folder, ...) \
    int name parameters { \
        NEXT(int, name, parameters); \
        mode_t mode = 0; \
        if (flags & (O_CREAT | __O_TMPFILE)) { \
            va_list list; \
            va_start(list, flags); \
            mode = va_arg(list, mode_t); \
            va_end(list); \
        } \
        FAIL(kind_of(flags), folder, path, -1); \
        return next(__VA_ARGS__, mode); \
    }
OPENS(open, (const char *path, int flags, ...), AT_FDCWD, path, flags)
OPENS(open64, (const char *path, int flags, ...), AT_FDCWD, path, flags)
OPENS(openat, (int folder, const char *path, int flags, ...), folder, folder, path, flags)
OPENS(openat64, (int folder, const char *path, int flags, ...), folder, folder, path, flags)

/* A function of the C library: its type, name, (parameters) and (arguments); the kind, folder and path of the operation; what it returns where that fails. */
#define STEP(type, name, parameters, arguments, kind, folder, path, failed) \
    type name parameters { \
        NEXT(type, name, parameters); \
        FAIL(kind, folder, path, failed); \
        return next arguments; \
    }

STEP(int, __open_2, (const char *path, int flags), (path, flags), kind_of(flags), AT_FDCWD, path, -1)
STEP(int, __open64_2, (const char *path, int flags), (path, flags), kind_of(flags), AT_FDCWD, path, -1)
STEP(int, creat, (const char *path, mode_t mode), (path, mode), OPEN, AT_FDCWD, path, -1)
STEP(FILE *, fopen, (const char *path, const char *mode), (path, mode), mode[0] == 'r' && !strchr(mode, '+') ? READ : OPEN, AT_FDCWD, path, NULL)
STEP(FILE *, fopen64, (const char *path, const char *mode), (path, mode), mode[0] == 'r' && !strchr(mode, '+') ? READ : OPEN, AT_FDCWD, path, NULL)

STEP(ssize_t, write, (int fd, const void *data, size_t size), (fd, data, size), WRITE, fd, NULL, -1)
STEP(ssize_t, writev, (int fd, const struct iovec *parts, int count), (fd, parts, count), WRITE, fd, NULL, -1)
STEP(ssize_t, pwrite, (int fd, const void *data, size_t size, off_t at), (fd, data, size, at), WRITE, fd, NULL, -1)
STEP(ssize_t, pwrite64, (int fd, const void *data, size_t size, off64_t at), (fd, data, size, at), WRITE, fd, NULL, -1)
STEP(size_t, fwrite, (const void *data, size_t size, size_t count, FILE *file), (data, size, count, file), WRITE, fileno(file), NULL, 0)
STEP(ssize_t, sendfile, (int to, int from, off_t *at, size_t size), (to, from, at, size), WRITE, to, NULL, -1)
STEP(ssize_t, sendfile64, (int to, int from, off64_t *at, size_t size), (to, from, at, size), WRITE, to, NULL, -1)
STEP(ssize_t, copy_file_range, (int from, off64_t *at, int to, off64_t *there, size_t size, unsigned flags), (from, at, to, there, size, flags),
     WRITE, to, NULL, -1)
STEP(int, ftruncate, (int fd, off_t size), (fd, size), WRITE, fd, NULL, -1)
STEP(int, ftruncate64, (int fd, off64_t size), (fd, size), WRITE, fd, NULL, -1)

STEP(int, fsync, (int fd), (fd), FSYNC, fd, NULL, -1)
STEP(int, fdatasync, (int fd), (fd), FSYNC, fd, NULL, -1)

STEP(int, rename, (const char *from, const char *to), (from, to), RENAME, AT_FDCWD, from, -1)
STEP(int, renameat, (int folder, const char *from, int other, const char *to), (folder, from, other, to), RENAME, folder, from, -1)
STEP(int, renameat2, (int folder, const char *from, int other, const char *to, unsigned flags), (folder, from, other, to, flags), RENAME, folder, from, -1)
STEP(int, mkdir, (const char *path, mode_t mode), (path, mode), MKDIR, AT_FDCWD, path, -1)
STEP(int, mkdirat, (int folder, const char *path, mode_t mode), (folder, path, mode), MKDIR, folder, path, -1)
STEP(int, unlink, (const char *path), (path), UNLINK, AT_FDCWD, path, -1)
STEP(int, unlinkat, (int folder, const char *path, int flags), (folder, path, flags), flags & AT_REMOVEDIR ? RMDIR : UNLINK, folder, path, -1)
STEP(int, remove, (const char *path), (path), UNLINK, AT_FDCWD, path, -1)
STEP(int, rmdir, (const char *path), (path), RMDIR, AT_FDCWD, path, -1)
