/* aft.h: a protected function of aftbed as a shared library.
 *
 * Write a C file that includes this header and defines the functions below, and build it:
 *
 *     cc -shared -fPIC -O2 -I DIRECTORY_OF_THIS_HEADER -o libmine.so mine.c
 *
 * The function is deterministic: `aft_execute` reads the request and the state and nothing else, and is the only
 * call that changes the state. No clock, no random numbers, no files, no threads: time comes in with the request.
 * Requests, replies and states are bytes whose meaning is yours.
 *
 * Instances. A process may host several instances: a test, the judge and the self-test of an update do. So the
 * state belongs to an instance, not to the library: `aft_init` makes one and gives its address, which is handed to
 * all other calls. A library with one global state sets `*instance` to the address of that state, or to NULL, and
 * can then have one instance at a time; a second one is refused.
 *
 * Calls come from one thread, one after another, each within 50 ms: a replica that answers later is taken for one
 * that hangs. A crash (SIGSEGV, abort) ends the process that hosts the replica, and the other replica goes on.
 *
 * Memory. Pointers are valid until the call returns. Buffers have no alignment and do not overlap. At most the given
 * number of bytes may be written; bytes that are not written are 0.
 *
 * Return codes: AFT_OK; AFT_REFUSED where it is allowed; any other is a fault, which ends the process that hosts the
 * replica.
 */
#ifndef AFT_H
#define AFT_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#if defined(__GNUC__)
#define AFT_EXPORT __attribute__((visibility("default")))
#else
#define AFT_EXPORT
#endif

#define AFT_OK 0
#define AFT_REFUSED 1 /* no such request, or no such state: nothing was changed */

#define AFT_REPLY_BYTES_MAX 61440
#define AFT_STATE_BYTES_MAX 67108864

/* -- required ------------------------------------------------------------------------------------------------ */

/* Make an instance in its initial state; `*instance` is NULL before. AFT_REFUSED is not allowed. */
AFT_EXPORT int aft_init(void **instance);

/* Execute a request: change the state, write a reply of at most `reply_max` bytes (AFT_REPLY_BYTES_MAX), set
 * `*reply_size`. AFT_REFUSED: the request has no meaning; its reply is empty, and the state must be as it was. */
AFT_EXPORT int aft_execute(void *instance, const uint8_t *request, size_t request_size,
                           uint8_t *reply, size_t reply_max, size_t *reply_size);

/* The size of the state now, in bytes, at most AFT_STATE_BYTES_MAX. It may change with each request. */
AFT_EXPORT int64_t aft_state_size(void *instance);

/* Write the whole state: `state_size` bytes, which `aft_state_size` has just returned. Equal states give equal bytes:
 * mind padding in structs, and pointers. AFT_REFUSED is not allowed. */
AFT_EXPORT int aft_capture(void *instance, uint8_t *state, size_t state_size);

/* Replace the whole state by one that another instance has captured. AFT_REFUSED: these bytes are no state, and the
 * state must be as it was. */
AFT_EXPORT int aft_restore(void *instance, const uint8_t *state, size_t state_size);

/* -- optional ------------------------------------------------------------------------------------------------ */

/* Free an instance. Not called when the process ends. */
AFT_EXPORT void aft_end(void *instance);

/* What the function declares of itself. Mechanisms are chosen by it. */
typedef struct {
    int deterministic; /* 1: equal states and requests give equal replies and states; else 0 */
    int state_access;  /* what capture and restore mean: one of the three below */
    double tolerance;  /* of AFT_APPROXIMATE: by how much a number in a reply may differ behind a restore; > 0 */
} aft_description;

#define AFT_EXACT 0
#define AFT_APPROXIMATE 1
#define AFT_NONE 2 /* no access: state_size, capture and restore have to be there, but are never called */

/* Change what differs from the defaults: 1, AFT_EXACT, 0.0. Called when the library is loaded. */
AFT_EXPORT void aft_describe(aft_description *description);

/* The executable assertion: 1 if `reply` can be right as an answer to `request`, else 0. It looks at nothing but these
 * two. Without it, every reply is acceptable. */
AFT_EXPORT int aft_acceptable(const uint8_t *request, size_t request_size, const uint8_t *reply, size_t reply_size);

#ifdef __cplusplus
}
#endif

#endif
