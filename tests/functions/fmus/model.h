/* The model of both FMUs: `total` is the integral of gain * u, `count` the steps while `active`.
 *
 * `fault` chooses what goes wrong in a step. It declares what it needs of FMI itself: no headers are required.
 * FORGETS: a captured state is without `count`. ONCE: a second instance is refused.
 */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum Status { OK, WARNING, DISCARD, ERROR, FATAL };
enum Fault { NONE, FAILS, DISCARDS, DIES, NOT_A_NUMBER, INFINITE, ENDS, RETURNS_EARLY };
enum Reference { U, GAIN, FAULT, ACTIVE, TOTAL, COUNT, WAS_ACTIVE, LIMIT, NAME, LEVEL };

typedef struct {
    double time, u, gain, limit, total;
    uint64_t count;
    int32_t fault, active;
} State;

typedef struct {
    State state;
    void *environment;
    void *logger;
} Instance;

static int instances;

static Instance *made(void *environment, void *logger)
{
#ifdef ONCE
    if (instances++)
        return NULL;
#endif
    Instance *found = calloc(1, sizeof *found);
    found->state.gain = 1.0;
    found->state.limit = 1e300;
    found->environment = environment;
    found->logger = logger;
    return found;
}

static double *real(State *state, uint32_t reference)
{
    switch (reference) {
    case U: return &state->u;
    case GAIN: return &state->gain;
    case TOTAL: return &state->total;
    case LIMIT: return &state->limit;
    default: return NULL;
    }
}

static int stepped(State *state, double time, double step)
{
    if (fabs(time - state->time) > 1e-9 || state->total > state->limit)
        return ERROR;
    state->time = time + step;
    state->total += state->gain * state->u * step;
    state->count += state->active != 0;
    switch (state->fault) {
    case FAILS: return ERROR;
    case DISCARDS: return DISCARD;
    case DIES: return FATAL;
    case NOT_A_NUMBER: state->total = NAN; break;
    case INFINITE: state->total = INFINITY; break;
    }
    return OK;
}

static int captured(Instance *instance, void **found)
{
    State *copy = malloc(sizeof *copy);
    *copy = instance->state;
#ifdef FORGETS
    copy->count = 0;
#endif
    *found = copy;
    return OK;
}

static int read_state(const char *bytes, size_t size, void **found)
{
    if (size != sizeof(State))
        return ERROR;
    *found = malloc(size);
    memcpy(*found, bytes, size);
    return OK;
}
