/* A disk that fails: preloaded, it disturbs what a process writes below $FAULTY_FOLDER.
 *
 * $FAULTY_AT  which write, counted from 1; 0 for none. A write is whatever changes the disk: making, opening for
 *             writing, writing to, resizing or renaming a file, making a folder.
 * $FAULTY_AS  full: this write and all later ones fail with ENOSPC, half of the data is written. io: this one fails with
 *             EIO, half of the data is written. kill: the process ends at it, half of the data is written.
 * $FAULTY_LOG file that gets a line for each write: its kind and path.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

#define REAL(name, type) static type real; if (!real) real = (type)dlsym(RTLD_NEXT, #name)
#define WRITES(flags) (((flags) & O_ACCMODE) != O_RDONLY)

static atomic_long count;

static void note(const char *kind, const char *path)
{
    typedef ssize_t (*writer)(int, const void *, size_t);
    REAL(write, writer);
    typedef int (*opener)(const char *, int, ...);
    static opener real_open;
    const char *log = getenv("FAULTY_LOG");
    char line[PATH_MAX + 32];
    if (!log)
        return;
    if (!real_open)
        real_open = (opener)dlsym(RTLD_NEXT, "open");
    int file = real_open(log, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0644);
    int length = snprintf(line, sizeof line, "%s %s\n", kind, path);
    if (file >= 0 && real(file, line, length) < 0)
        abort();
    close(file);
}

static int below(const char *path)
{
    const char *folder = getenv("FAULTY_FOLDER");
    return folder && path && strncmp(path, folder, strlen(folder)) == 0;
}

/* 0: go on. Otherwise the error number; -1: end the process. */
static int fault(const char *kind, const char *path)
{
    if (!below(path))
        return 0;
    const char *at = getenv("FAULTY_AT"), *as = getenv("FAULTY_AS");
    long number = atomic_fetch_add(&count, 1) + 1, wanted = at ? atol(at) : 0;
    note(kind, path);
    if (!wanted || !as || number < wanted)
        return 0;
    if (strcmp(as, "full") == 0)
        return ENOSPC;
    if (number > wanted)
        return 0;
    return strcmp(as, "io") == 0 ? EIO : -1;
}

static int fault_of_descriptor(const char *kind, int file)
{
    char link[64], path[PATH_MAX];
    if (!getenv("FAULTY_FOLDER"))
        return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0)
        return 0;
    path[length] = 0;
    return fault(kind, path);
}

static int fails(int number)
{
    if (number < 0)
        kill(getpid(), SIGKILL);
    if (number)
        errno = number;
    return number;
}

static const char *absolute(const char *path, char *buffer)
{
    char folder[PATH_MAX];
    if (!path || path[0] == '/' || !getcwd(folder, sizeof folder))
        return path;
    return snprintf(buffer, PATH_MAX, "%s/%s", folder, path) < PATH_MAX ? buffer : path;
}

#define OPENER(name, head, arguments, pathname)                                             \
    int name head                                                                           \
    {                                                                                       \
        typedef int (*type) head;                                                           \
        REAL(name, type);                                                                   \
        char buffer[PATH_MAX];                                                              \
        mode_t mode = 0;                                                                    \
        if (flags & (O_CREAT | O_TMPFILE)) {                                                \
            va_list more;                                                                   \
            va_start(more, flags);                                                          \
            mode = va_arg(more, mode_t);                                                    \
            va_end(more);                                                                   \
        }                                                                                   \
        if (WRITES(flags) && fails(fault("open", absolute(pathname, buffer))))              \
            return -1;                                                                      \
        return real arguments;                                                              \
    }

OPENER(open, (const char *path, int flags, ...), (path, flags, mode), path)
OPENER(open64, (const char *path, int flags, ...), (path, flags, mode), path)
OPENER(openat, (int folder, const char *path, int flags, ...), (folder, path, flags, mode), path)
OPENER(openat64, (int folder, const char *path, int flags, ...), (folder, path, flags, mode), path)

#define STREAM(name)                                                                        \
    FILE *name(const char *restrict path, const char *restrict mode)                        \
    {                                                                                       \
        typedef FILE *(*type)(const char *, const char *);                                  \
        REAL(name, type);                                                                   \
        char buffer[PATH_MAX];                                                              \
        if (strpbrk(mode, "wa+") && fails(fault("open", absolute(path, buffer))))           \
            return NULL;                                                                    \
        return real(path, mode);                                                            \
    }

STREAM(fopen)
STREAM(fopen64)

ssize_t write(int file, const void *data, size_t size)
{
    typedef ssize_t (*type)(int, const void *, size_t);
    REAL(write, type);
    int number = fault_of_descriptor("write", file);
    if (number && size > 1 && real(file, data, size / 2) < 0)
        return -1;
    return fails(number) ? -1 : real(file, data, size);
}

ssize_t writev(int file, const struct iovec *parts, int many)
{
    typedef ssize_t (*type)(int, const struct iovec *, int);
    REAL(writev, type);
    int number = fault_of_descriptor("write", file);
    if (number && many > 1 && real(file, parts, many / 2) < 0)
        return -1;
    return fails(number) ? -1 : real(file, parts, many);
}

#define PLACED(name, offset)                                                                \
    ssize_t name(int file, const void *data, size_t size, offset at)                        \
    {                                                                                       \
        typedef ssize_t (*type)(int, const void *, size_t, offset);                         \
        REAL(name, type);                                                                   \
        int number = fault_of_descriptor("write", file);                                    \
        if (number && size > 1 && real(file, data, size / 2, at) < 0)                       \
            return -1;                                                                      \
        return fails(number) ? -1 : real(file, data, size, at);                             \
    }

PLACED(pwrite, off_t)
PLACED(pwrite64, off64_t)

size_t fwrite(const void *restrict data, size_t size, size_t many, FILE *restrict stream)
{
    typedef size_t (*type)(const void *, size_t, size_t, FILE *);
    REAL(fwrite, type);
    int number = fault_of_descriptor("write", fileno(stream));
    if (number && many > 1)
        real(data, size, many / 2, stream);
    return fails(number) ? 0 : real(data, size, many, stream);
}

#define CHANGE(name, head, arguments, path)                                                 \
    int name head                                                                           \
    {                                                                                       \
        typedef int (*type) head;                                                           \
        REAL(name, type);                                                                   \
        char buffer[PATH_MAX];                                                              \
        return fails(fault(#name, absolute(path, buffer))) ? -1 : real arguments;           \
    }

CHANGE(mkdir, (const char *path, mode_t mode), (path, mode), path)
CHANGE(mkdirat, (int folder, const char *path, mode_t mode), (folder, path, mode), path)
CHANGE(rename, (const char *from, const char *to), (from, to), to)
CHANGE(renameat, (int from, const char *old, int to, const char *path), (from, old, to, path), path)
CHANGE(renameat2, (int from, const char *old, int to, const char *path, unsigned flags), (from, old, to, path, flags),
       path)
CHANGE(symlink, (const char *target, const char *path), (target, path), path)
CHANGE(truncate, (const char *path, off_t size), (path, size), path)

int ftruncate(int file, off_t size)
{
    typedef int (*type)(int, off_t);
    REAL(ftruncate, type);
    return fails(fault_of_descriptor("ftruncate", file)) ? -1 : real(file, size);
}

int ftruncate64(int file, off64_t size)
{
    return ftruncate(file, size);
}

int posix_fallocate(int file, off_t offset, off_t size)
{
    typedef int (*type)(int, off_t, off_t);
    REAL(posix_fallocate, type);
    int number = fails(fault_of_descriptor("fallocate", file));
    return number ? number : real(file, offset, size);
}
