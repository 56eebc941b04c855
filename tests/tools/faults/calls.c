/* A library that is loaded before the C library (LD_PRELOAD): it counts the calls by which a process changes or reads files below one folder, and makes
 * the k-th one fail, ends the process before it, or writes the calls with their data to a log.
 *
 * Built and armed by preload.py. Threads may call at the same time. Descriptors are recognised by the path that they were opened with.
 *
 * A line of the log is: kind, descriptor, offset, length, two paths, each followed by a NUL; then `length` bytes of data.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { OPEN = 1, WRITE = 2, READ = 4, RENAME = 8, LINK = 16, SYNC = 32, TRUNCATE = 64, MKDIR = 128, UNLINK = 256 };
enum { COUNT, FAIL_ONCE, FAIL_FROM, END };

#define DESCRIPTORS 4096

static char folder[PATH_MAX];
static size_t folder_length;
static int kinds, mode, error_number, log_descriptor = -1;
static long target;
static struct { long counted; int failed_kind; char failed_path[PATH_MAX]; } *shared; /* with the process that forked this one */
static char *opened[DESCRIPTORS]; /* the path of each descriptor of a watched file */
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;


__attribute__((constructor)) static void begin(void) {
    shared = mmap(NULL, sizeof *shared, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
}

/* Functions that preload.py calls. */

void faults_arm(const char *watched, int which, int how, long k, int number, int log) {
    pthread_mutex_lock(&lock);
    snprintf(folder, sizeof folder, "%s", watched);
    folder_length = strlen(folder);
    kinds = which, mode = how, target = k, error_number = number, log_descriptor = log, shared->counted = 0;
    shared->failed_path[0] = 0;
    pthread_mutex_unlock(&lock);
}

long faults_counted(void) { return shared->counted; }
int faults_failed_kind(void) { return shared->failed_kind; }
const char *faults_failed_path(void) { return shared->failed_path; }

/* Helpers. */

static int absolute(int directory, const char *path, char *out) {
    char base[PATH_MAX];
    if (!path) return 0;
    if (path[0] == '/') {
        snprintf(out, PATH_MAX, "%s", path);
    } else {
        if (directory == AT_FDCWD) {
            if (!getcwd(base, sizeof base)) return 0;
        } else {
            char link[64];
            snprintf(link, sizeof link, "/proc/self/fd/%d", directory);
            ssize_t length = readlink(link, base, sizeof base - 1);
            if (length < 0) return 0;
            base[length] = 0;
        }
        if (strlen(base) + strlen(path) + 2 > PATH_MAX) return 0;
        strcpy(out, base);
        strcat(out, "/");
        strcat(out, path);
    }
    return 1;
}

static int is_watched(const char *path) {
    return folder_length && !strncmp(path, folder, folder_length) && (path[folder_length] == '/' || !path[folder_length]);
}

static const char *path_of(int descriptor) {
    return descriptor >= 0 && descriptor < DESCRIPTORS ? opened[descriptor] : NULL;
}

static void remember(int descriptor, const char *path) {
    if (descriptor < 0 || descriptor >= DESCRIPTORS) return;
    free(opened[descriptor]);
    opened[descriptor] = path ? strdup(path) : NULL;
}

/* Count a call; return 1 with errno set if it must fail. */
static int fails(int kind, const char *path) {
    int result = 0;
    if (!(kinds & kind)) return 0;
    pthread_mutex_lock(&lock);
    long number = ++shared->counted;
    if (mode != COUNT && (number == target || (mode == FAIL_FROM && number > target))) {
        if (!shared->failed_path[0]) shared->failed_kind = kind, snprintf(shared->failed_path, sizeof shared->failed_path, "%s", path);
        if (mode == END) syscall(SYS_exit_group, 137);
        errno = error_number;
        result = 1;
    }
    pthread_mutex_unlock(&lock);
    return result;
}

static void put(const void *data, size_t length) {
    const char *next = data;
    while (length) {
        long written = syscall(SYS_write, log_descriptor, next, length);
        if (written <= 0) syscall(SYS_exit_group, 99);
        next += written, length -= (size_t)written;
    }
}

static void record(const char *kind, int descriptor, long offset, const void *data, size_t length, const char *path, const char *other) {
    if (log_descriptor < 0) return;
    char head[128];
    int number = errno;
    pthread_mutex_lock(&lock);
    int size = snprintf(head, sizeof head, "%s %d %ld %zu", kind, descriptor, offset, length) + 1;
    put(head, (size_t)size);
    put(path, strlen(path) + 1);
    put(other ? other : "", strlen(other ? other : "") + 1);
    if (data) put(data, length);
    pthread_mutex_unlock(&lock);
    errno = number;
}

/* Opening and closing. */

static int opens(int directory, const char *path, int flags, mode_t permissions) {
    char full[PATH_MAX];
    int watched = absolute(directory, path, full) && is_watched(full);
    int is_new = 0;
    if (watched) {
        if (fails(OPEN, full)) return -1;
        struct stat found;
        is_new = (flags & O_CREAT) && stat(full, &found) < 0;
    }
    int result = (int)syscall(SYS_openat, directory, path, flags | O_LARGEFILE, permissions);
    if (result >= 0) remember(result, watched ? full : NULL);
    if (result >= 0 && watched && (is_new || (flags & O_TRUNC))) record(is_new ? "create" : "empty", result, 0, NULL, 0, full, NULL);
    return result;
}

#define PERMISSIONS(last) \
    mode_t permissions = 0; \
    if (flags & (O_CREAT | __O_TMPFILE)) { va_list list; va_start(list, last); permissions = va_arg(list, mode_t); va_end(list); }

int open(const char *path, int flags, ...) { PERMISSIONS(flags) return opens(AT_FDCWD, path, flags, permissions); }
int open64(const char *path, int flags, ...) { PERMISSIONS(flags) return opens(AT_FDCWD, path, flags, permissions); }
int openat(int directory, const char *path, int flags, ...) { PERMISSIONS(flags) return opens(directory, path, flags, permissions); }
int openat64(int directory, const char *path, int flags, ...) { PERMISSIONS(flags) return opens(directory, path, flags, permissions); }
int creat(const char *path, mode_t permissions) { return opens(AT_FDCWD, path, O_CREAT | O_WRONLY | O_TRUNC, permissions); }
int creat64(const char *path, mode_t permissions) { return opens(AT_FDCWD, path, O_CREAT | O_WRONLY | O_TRUNC, permissions); }

int close(int descriptor) {
    remember(descriptor, NULL);
    return (int)syscall(SYS_close, descriptor);
}

/* Writing. The offset of a plain write is that of the descriptor. */

static int writes(int descriptor, const void *data, size_t length, long offset, const char **path) {
    (void)data, (void)length, (void)offset;
    *path = path_of(descriptor);
    return *path && fails(WRITE, *path);
}

ssize_t write(int descriptor, const void *data, size_t length) {
    const char *path;
    if (writes(descriptor, data, length, 0, &path)) return -1;
    ssize_t result = syscall(SYS_write, descriptor, data, length);
    if (path && result > 0) record("write", descriptor, lseek(descriptor, 0, SEEK_CUR) - result, data, (size_t)result, path, NULL);
    return result;
}

ssize_t pwrite64(int descriptor, const void *data, size_t length, off64_t offset) {
    const char *path;
    if (writes(descriptor, data, length, offset, &path)) return -1;
    ssize_t result = syscall(SYS_pwrite64, descriptor, data, length, offset);
    if (path && result > 0) record("write", descriptor, offset, data, (size_t)result, path, NULL);
    return result;
}

ssize_t pwrite(int descriptor, const void *data, size_t length, off_t offset) { return pwrite64(descriptor, data, length, offset); }

ssize_t writev(int descriptor, const struct iovec *parts, int count) {
    if (!path_of(descriptor)) return syscall(SYS_writev, descriptor, parts, count);
    ssize_t total = 0;
    for (int part = 0; part < count; part++) {
        ssize_t written = write(descriptor, parts[part].iov_base, parts[part].iov_len);
        if (written < 0) return total ? total : -1;
        total += written;
        if ((size_t)written < parts[part].iov_len) break;
    }
    return total;
}

int ftruncate64(int descriptor, off64_t length) {
    const char *path = path_of(descriptor);
    if (path && fails(TRUNCATE, path)) return -1;
    int result = (int)syscall(SYS_ftruncate, descriptor, length);
    if (path && !result) record("truncate", descriptor, length, NULL, 0, path, NULL);
    return result;
}

int ftruncate(int descriptor, off_t length) { return ftruncate64(descriptor, length); }

/* Reading. */

ssize_t read(int descriptor, void *data, size_t length) {
    const char *path = path_of(descriptor);
    if (path && fails(READ, path)) return -1;
    return syscall(SYS_read, descriptor, data, length);
}

ssize_t pread64(int descriptor, void *data, size_t length, off64_t offset) {
    const char *path = path_of(descriptor);
    if (path && fails(READ, path)) return -1;
    return syscall(SYS_pread64, descriptor, data, length, offset);
}

ssize_t pread(int descriptor, void *data, size_t length, off_t offset) { return pread64(descriptor, data, length, offset); }

/* Syncing. */

static int syncs(int number, int descriptor) {
    const char *path = path_of(descriptor);
    if (path && fails(SYNC, path)) return -1;
    int result = (int)syscall(number, descriptor);
    if (path && !result) record("sync", descriptor, 0, NULL, 0, path, NULL);
    return result;
}

int fsync(int descriptor) { return syncs(SYS_fsync, descriptor); }
int fdatasync(int descriptor) { return syncs(SYS_fdatasync, descriptor); }

/* Names. */

static int two_paths(int kind, const char *what, int old_directory, const char *old, int new_directory, const char *new, long number, int flags) {
    char from[PATH_MAX], to[PATH_MAX];
    int watched = absolute(old_directory, old, from) && absolute(new_directory, new, to) && (is_watched(from) || is_watched(to));
    if (watched && fails(kind, to)) return -1;
    int result = (int)syscall(number, old_directory, old, new_directory, new, flags);
    if (watched && !result) record(what, -1, 0, NULL, 0, from, to);
    return result;
}

int rename(const char *old, const char *new) { return two_paths(RENAME, "rename", AT_FDCWD, old, AT_FDCWD, new, SYS_renameat2, 0); }
int renameat(int a, const char *old, int b, const char *new) { return two_paths(RENAME, "rename", a, old, b, new, SYS_renameat2, 0); }
int renameat2(int a, const char *old, int b, const char *new, unsigned flags) { return two_paths(RENAME, "rename", a, old, b, new, SYS_renameat2, (int)flags); }
int link(const char *old, const char *new) { return two_paths(LINK, "link", AT_FDCWD, old, AT_FDCWD, new, SYS_linkat, 0); }
int linkat(int a, const char *old, int b, const char *new, int flags) { return two_paths(LINK, "link", a, old, b, new, SYS_linkat, flags); }

static int one_path(int kind, const char *what, int directory, const char *path, long number, int extra) {
    char full[PATH_MAX];
    int watched = absolute(directory, path, full) && is_watched(full);
    if (watched && fails(kind, full)) return -1;
    int result = (int)syscall(number, directory, path, extra);
    if (watched && !result) record(what, -1, 0, NULL, 0, full, NULL);
    return result;
}

int mkdir(const char *path, mode_t permissions) { return one_path(MKDIR, "mkdir", AT_FDCWD, path, SYS_mkdirat, (int)permissions); }
int mkdirat(int directory, const char *path, mode_t permissions) { return one_path(MKDIR, "mkdir", directory, path, SYS_mkdirat, (int)permissions); }
int unlink(const char *path) { return one_path(UNLINK, "unlink", AT_FDCWD, path, SYS_unlinkat, 0); }
int rmdir(const char *path) { return one_path(UNLINK, "rmdir", AT_FDCWD, path, SYS_unlinkat, AT_REMOVEDIR); }
int unlinkat(int directory, const char *path, int flags) { return one_path(UNLINK, flags & AT_REMOVEDIR ? "rmdir" : "unlink", directory, path, SYS_unlinkat, flags); }
int remove(const char *path) { int result = unlink(path); return result && errno == EISDIR ? rmdir(path) : result; }
