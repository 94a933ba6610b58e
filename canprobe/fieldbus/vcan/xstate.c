/* ptrace(2) for a user-mode Linux older than 6.13 on a processor with AMX, loaded before its C library.
 *
 * That kernel holds the extended registers of its processes in a buffer of fixed size. This machine's do not fit, and it
 * refuses to set a part of them (x86: NT_X86_XSTATE takes the whole area or nothing): the first process would crash. What
 * does not fit, tile registers, which nobody in the guest has asked to use, is left as it is.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

#define MOST 65536 /* too large for the stack of a guest's kernel, which is one thread and changes none within this call */

long ptrace(enum __ptrace_request request, ...)
{
    va_list arguments;
    va_start(arguments, request);
    int pid = va_arg(arguments, int);
    void *address = va_arg(arguments, void *);
    struct iovec *part = va_arg(arguments, void *);
    va_end(arguments);

    long (*next)(int, int, void *, void *) = (long (*)(int, int, void *, void *))dlsym(RTLD_NEXT, "ptrace");
    int extended = address == (void *)NT_X86_XSTATE;
    if (!extended || (request != PTRACE_GETREGSET && request != PTRACE_SETREGSET))
        return next(request, pid, address, part);

    static char area[MOST];
    struct iovec whole = {area, MOST};
    long result = next(PTRACE_GETREGSET, pid, address, &whole);
    if (result < 0)
        return result;
    size_t length = part->iov_len < whole.iov_len ? part->iov_len : whole.iov_len;
    if (request == PTRACE_GETREGSET) {
        memcpy(part->iov_base, area, length);
        part->iov_len = length;
        return 0;
    }
    memcpy(area, part->iov_base, length);
    return next(PTRACE_SETREGSET, pid, address, &whole);
}
