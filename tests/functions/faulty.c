/* A function that does what the first byte of a request says. Its state is `size` bytes of `value`. */
#include <stdlib.h>
#include <string.h>
#include "aft.h"

struct state {
    int64_t size;
    uint8_t value;
    int capture_code, capture_too_much, restore_code;
};

#ifdef ONE_STATE
static struct state only;
#endif

int aft_init(void **instance) {
#if defined(INIT_CODE)
    return INIT_CODE;
#elif defined(ONE_STATE)
    memset(&only, 0, sizeof only);
    return AFT_OK;
#else
    *instance = calloc(1, sizeof(struct state));
    return AFT_OK;
#endif
}

static struct state *of(void *instance) {
#ifdef ONE_STATE
    return &only;
#else
    return instance;
#endif
}

#ifndef LACKS
int aft_execute(void *instance, const uint8_t *request, size_t request_size, uint8_t *reply, size_t reply_max,
                size_t *reply_size) {
    struct state *state = of(instance);
    *reply_size = 0;
    switch (request_size ? request[0] : 0) {
    case 'e': /* echo */
        memcpy(reply, request, *reply_size = request_size);
        return AFT_OK;
    case 'm': /* as much as there is room for */
        memset(reply, 'm', *reply_size = reply_max);
        return AFT_OK;
    case 'w': /* one byte too many, which it does not even admit */
        memset(reply, 'w', reply_max + 1);
        return AFT_OK;
    case 's': /* a size that is too large */
        *reply_size = reply_max + 1;
        return AFT_OK;
    case 'n': /* a size that is not set */
        *reply_size = SIZE_MAX;
        return AFT_OK;
    case 'u': /* a reply of which it writes nothing */
        *reply_size = 4;
        return AFT_OK;
    case 'r':
        return AFT_REFUSED;
    case 'f':
        return -7;
    case 'S': /* the size of the state */
        memcpy(&state->size, request + 1, sizeof state->size);
        return AFT_OK;
    case 'V':
        state->value = request[1];
        return AFT_OK;
    case 'C':
        state->capture_code = request[1];
        return AFT_OK;
    case 'T':
        state->capture_too_much = 1;
        return AFT_OK;
    case 'R':
        state->restore_code = request[1];
        return AFT_OK;
    case 'X':
        abort();
    }
    return AFT_REFUSED;
}

int64_t aft_state_size(void *instance) { return of(instance)->size; }
#endif

int aft_capture(void *instance, uint8_t *state, size_t state_size) {
    memset(state, of(instance)->value, state_size + of(instance)->capture_too_much);
    return of(instance)->capture_code;
}

int aft_restore(void *instance, const uint8_t *state, size_t state_size) {
    if (of(instance)->restore_code)
        return of(instance)->restore_code;
    of(instance)->size = (int64_t)state_size;
    of(instance)->value = state_size ? state[0] : 0;
    return AFT_OK;
}

static int ended;

void aft_end(void *instance) {
    ended++;
#ifndef ONE_STATE
    free(instance);
#endif
}

AFT_EXPORT int ended_so_far(void) { return ended; }

int aft_acceptable(const uint8_t *request, size_t request_size, const uint8_t *reply, size_t reply_size) {
    if (request_size && request[0] == '?')
        return 2;
    return request_size == reply_size && !memcmp(request, reply, reply_size);
}

#ifdef DESCRIBE
void aft_describe(aft_description *description) { DESCRIBE }
#endif
