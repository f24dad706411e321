/* A driving world in plain C, the peer of `cavmarl bench step`.

   It does what a step of the `drive` environment of pufferlib 3.0 is described to do, with its data
   layout, and is written from that description: one struct for each car and each line of the road,
   a grid of 5 m cells with at most 10 road segments each, for each cell the list of the segments of
   the 21 x 21 cells around it, in a spiral; a car moves by the kinematic bicycle, is tested against
   the road edges of 25 cells and against every other car, and observes 1,847 floats: 6 of its own,
   7 for each of 63 others within 50 m, 7 for each of the first 200 segments of its cell's list.
   What is left out: logs, pedestrians, drivers that follow a recording, the height. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { LANE = 4, LINE = 5, EDGE = 6 };
enum { NO_CONTACT = 0, HIT_CAR = 1, HIT_EDGE = 2 };
enum { OWN = 6, FEATURES = 7, PARTNERS = 63, SEGMENTS = 200 };
enum { OBSERVATION = OWN + FEATURES * (PARTNERS + SEGMENTS) };
enum { PER_CELL = 10, SLOTS = 1 + 2 * PER_CELL, SPIRAL = 21, AROUND = 2 };

static const float CELL_M = 5.0f;
static const float DT_S = 0.1f;
static const float ACCELERATIONS[7] = {-4.0f, -2.667f, -1.333f, 0.0f, 1.333f, 2.667f, 4.0f};
static const float STEERINGS[13] = {-1.0f,   -0.833f, -0.667f, -0.5f,  -0.333f, -0.167f, 0.0f,
                                    0.167f,  0.333f,  0.5f,    0.667f, 0.833f,  1.0f};

typedef struct {
    int type, size;
    float *xs, *ys; /* of a line */
    float width, length;
    float goal_x, goal_y;
    float start_x, start_y, start_heading, start_speed;
    int contact;
    float x, y, vx, vy, heading, cos, sin; /* of a car */
    int reached, respawned_at;
} Entity;

typedef struct {
    Entity *entities; /* the cars, then the lines */
    int num_cars, num_entities;
    float min_x, min_y, max_x, max_y;
    int columns, rows;
    int *cells;      /* count, then (entity, segment) pairs */
    int *list_start; /* of each cell's list, in ints */
    int *lists;
    int timestep;
} World;

static int cell_of(const World *world, float x, float y) {
    int columns = (int)ceilf((world->max_x - world->min_x) / CELL_M);
    int rows = (int)ceilf((world->max_y - world->min_y) / CELL_M);
    int column = (int)((x - world->min_x) / CELL_M);
    int row = (int)((y - world->min_y) / CELL_M);
    if (x < world->min_x || column >= columns || y < world->min_y || row >= rows) return -1;
    return row * columns + column;
}

static void fill_cells(World *world) {
    world->columns = (int)ceilf((world->max_x - world->min_x) / CELL_M);
    world->rows = (int)ceilf((world->max_y - world->min_y) / CELL_M);
    world->cells = calloc((size_t)world->columns * world->rows * SLOTS, sizeof(int));
    for (int e = world->num_cars; e < world->num_entities; e++) {
        const Entity *line = &world->entities[e];
        for (int k = 0; k + 1 < line->size; k++) {
            float x = (line->xs[k] + line->xs[k + 1]) / 2.0f;
            float y = (line->ys[k] + line->ys[k + 1]) / 2.0f;
            int index = cell_of(world, x, y);
            if (index < 0) continue;
            int *cell = &world->cells[index * SLOTS];
            if (cell[0] == PER_CELL) continue;
            cell[1 + 2 * cell[0]] = e;
            cell[2 + 2 * cell[0]] = k;
            cell[0]++;
        }
    }
}

/* The cells around one, going round it to the right, up, left, down with growing sides. */
static void make_spiral(int (*offsets)[2]) {
    static const int TURN[4][2] = {{1, 0}, {0, 1}, {-1, 0}, {0, -1}};
    int x = 0, y = 0, total = 1;
    offsets[0][0] = offsets[0][1] = 0;
    for (int side = 0; total < SPIRAL * SPIRAL; side++)
        for (int step = 0; step < side / 2 + 1 && total < SPIRAL * SPIRAL; step++) {
            x += TURN[side % 4][0];
            y += TURN[side % 4][1];
            offsets[total][0] = x;
            offsets[total][1] = y;
            total++;
        }
}

static int list_cell(const World *world, int cell, int (*offsets)[2], int *out) {
    int size = 0;
    for (int k = 0; k < SPIRAL * SPIRAL; k++) {
        int column = cell % world->columns + offsets[k][0];
        int row = cell / world->columns + offsets[k][1];
        if (column < 0 || column >= world->columns || row < 0 || row >= world->rows) continue;
        const int *near = &world->cells[(row * world->columns + column) * SLOTS];
        if (out) memcpy(&out[size], &near[1], 2 * near[0] * sizeof(int));
        size += 2 * near[0];
    }
    return size;
}

static void fill_lists(World *world) {
    int offsets[SPIRAL * SPIRAL][2];
    int cells = world->columns * world->rows;
    make_spiral(offsets);
    world->list_start = calloc(cells + 1, sizeof(int));
    for (int c = 0; c < cells; c++)
        world->list_start[c + 1] = world->list_start[c] + list_cell(world, c, offsets, NULL);
    world->lists = calloc(world->list_start[cells] + 1, sizeof(int));
    for (int c = 0; c < cells; c++)
        list_cell(world, c, offsets, &world->lists[world->list_start[c]]);
}

static void place(Entity *car, float x, float y, float heading, float speed) {
    car->x = x;
    car->y = y;
    car->heading = heading;
    car->cos = cosf(heading);
    car->sin = sinf(heading);
    car->vx = speed * car->cos;
    car->vy = speed * car->sin;
}

static void set_out(World *world) {
    world->timestep = 0;
    for (int c = 0; c < world->num_cars; c++) {
        Entity *car = &world->entities[c];
        place(car, car->start_x, car->start_y, car->start_heading, car->start_speed);
        car->contact = NO_CONTACT;
        car->reached = 0;
        car->respawned_at = -1;
    }
}

static void move(Entity *car, float acceleration, float steering) {
    float speed = sqrtf(car->vx * car->vx + car->vy * car->vy) + 0.5f * acceleration * DT_S;
    speed = fmaxf(fminf(speed, 100.0f), -100.0f);
    float beta = tanhf(0.5f * tanf(steering));
    float yaw_rate = speed * cosf(beta) * tanf(steering) / car->length;
    car->vx = speed * cosf(car->heading + beta);
    car->vy = speed * sinf(car->heading + beta);
    car->x += car->vx * DT_S;
    car->y += car->vy * DT_S;
    car->heading += yaw_rate * DT_S;
    car->cos = cosf(car->heading);
    car->sin = sinf(car->heading);
}

static void corners_of(const Entity *car, float (*corners)[2]) {
    static const float SIDES[4][2] = {{-1, 1}, {1, 1}, {1, -1}, {-1, -1}};
    for (int k = 0; k < 4; k++) {
        float along = SIDES[k][0] * car->length / 2.0f, left = SIDES[k][1] * car->width / 2.0f;
        corners[k][0] = car->x + along * car->cos - left * car->sin;
        corners[k][1] = car->y + along * car->sin + left * car->cos;
    }
}

static int segments_cross(const float *a, const float *b, const float *c, const float *d) {
    if (fmaxf(a[0], b[0]) < fminf(c[0], d[0]) || fminf(a[0], b[0]) > fmaxf(c[0], d[0]) ||
        fmaxf(a[1], b[1]) < fminf(c[1], d[1]) || fminf(a[1], b[1]) > fmaxf(c[1], d[1]))
        return 0;
    float ux = b[0] - a[0], uy = b[1] - a[1], vx = d[0] - c[0], vy = d[1] - c[1];
    float cross = ux * vy - uy * vx;
    if (cross == 0.0f) return 0;
    float wx = a[0] - c[0], wy = a[1] - c[1];
    float s = (ux * wy - uy * wx) / cross, t = (vx * wy - vy * wx) / cross;
    return s >= 0.0f && s <= 1.0f && t >= 0.0f && t <= 1.0f;
}

static int crosses_edge(const World *world, const Entity *car) {
    float corners[4][2];
    int found[(2 * AROUND + 1) * (2 * AROUND + 1) * 2 * PER_CELL], size = 0;
    int cell = cell_of(world, car->x, car->y);
    if (cell < 0) return 0;
    corners_of(car, corners);
    for (int j = -AROUND; j <= AROUND; j++)
        for (int i = -AROUND; i <= AROUND; i++) {
            int column = cell % world->columns + i, row = cell / world->columns + j;
            if (column < 0 || column >= world->columns || row < 0 || row >= world->rows) continue;
            const int *near = &world->cells[(row * world->columns + column) * SLOTS];
            for (int k = 0; k < 2 * near[0]; k++) found[size++] = near[1 + k];
        }
    for (int f = 0; f < size; f += 2) {
        const Entity *line = &world->entities[found[f]];
        if (line->type != EDGE) continue;
        int k = found[f + 1];
        float begin[2] = {line->xs[k], line->ys[k]};
        float end[2] = {line->xs[k + 1], line->ys[k + 1]};
        for (int side = 0; side < 4; side++)
            if (segments_cross(corners[side], corners[(side + 1) % 4], begin, end)) return 1;
    }
    return 0;
}

static int cars_touch(const Entity *a, const Entity *b) {
    float p[4][2], q[4][2];
    float axes[4][2] = {{a->cos, a->sin}, {-a->sin, a->cos}, {b->cos, b->sin}, {-b->sin, b->cos}};
    corners_of(a, p);
    corners_of(b, q);
    for (int k = 0; k < 4; k++) {
        float min_p = INFINITY, max_p = -INFINITY, min_q = INFINITY, max_q = -INFINITY;
        for (int c = 0; c < 4; c++) {
            float at_p = p[c][0] * axes[k][0] + p[c][1] * axes[k][1];
            float at_q = q[c][0] * axes[k][0] + q[c][1] * axes[k][1];
            min_p = fminf(min_p, at_p);
            max_p = fmaxf(max_p, at_p);
            min_q = fminf(min_q, at_q);
            max_q = fmaxf(max_q, at_q);
        }
        if (max_p < min_q || min_p > max_q) return 0;
    }
    return 1;
}

static int contact_of(const World *world, const Entity *car) {
    int contact = crosses_edge(world, car) ? HIT_EDGE : NO_CONTACT;
    for (int c = 0; c < world->num_cars; c++) {
        const Entity *other = &world->entities[c];
        if (other == car) continue;
        float dx = other->x - car->x, dy = other->y - car->y;
        if (dx * dx + dy * dy > 225.0f) continue;
        if (cars_touch(car, other)) return HIT_CAR;
    }
    return contact;
}

static void observe_car(const World *world, const Entity *car, float *out) {
    float goal_x = car->goal_x - car->x, goal_y = car->goal_y - car->y;
    out[0] = (goal_x * car->cos + goal_y * car->sin) * 0.005f;
    out[1] = (goal_y * car->cos - goal_x * car->sin) * 0.005f;
    out[2] = sqrtf(car->vx * car->vx + car->vy * car->vy) * 0.01f;
    out[3] = car->width / 15.0f;
    out[4] = car->length / 30.0f;
    out[5] = car->contact != NO_CONTACT ? 1.0f : 0.0f;
    out += OWN;
    int seen = 0;
    for (int c = 0; c < world->num_cars && seen < PARTNERS; c++) {
        const Entity *other = &world->entities[c];
        if (other == car || car->respawned_at >= 0 || other->respawned_at >= 0) continue;
        float dx = other->x - car->x, dy = other->y - car->y;
        if (dx * dx + dy * dy > 2500.0f) continue;
        out[0] = (dx * car->cos + dy * car->sin) * 0.02f;
        out[1] = (dy * car->cos - dx * car->sin) * 0.02f;
        out[2] = other->width / 15.0f;
        out[3] = other->length / 30.0f;
        out[4] = other->cos * car->cos + other->sin * car->sin;
        out[5] = other->sin * car->cos - other->cos * car->sin;
        out[6] = sqrtf(other->vx * other->vx + other->vy * other->vy) / 100.0f;
        out += FEATURES;
        seen++;
    }
    memset(out, 0, (PARTNERS - seen) * FEATURES * sizeof(float));
    out += (PARTNERS - seen) * FEATURES;

    int list[2 * SEGMENTS], size = 0;
    int cell = cell_of(world, car->x, car->y);
    if (cell >= 0) {
        size = (world->list_start[cell + 1] - world->list_start[cell]) / 2;
        if (size > SEGMENTS) size = SEGMENTS;
        memcpy(list, &world->lists[world->list_start[cell]], 2 * size * sizeof(int));
    }
    for (int k = 0; k < size; k++) {
        const Entity *line = &world->entities[list[2 * k]];
        int at = list[2 * k + 1];
        float end_x = line->xs[at + 1], end_y = line->ys[at + 1];
        float mid_x = (line->xs[at] + end_x) / 2.0f, mid_y = (line->ys[at] + end_y) / 2.0f;
        float dx = mid_x - car->x, dy = mid_y - car->y;
        float ahead_x = end_x - mid_x, ahead_y = end_y - mid_y;
        float half = sqrtf(ahead_x * ahead_x + ahead_y * ahead_y);
        out[0] = (dx * car->cos + dy * car->sin) * 0.02f;
        out[1] = (dy * car->cos - dx * car->sin) * 0.02f;
        out[2] = half / 100.0f;
        out[3] = 0.1f / 100.0f;
        if (half > 0.0f) {
            ahead_x /= half;
            ahead_y /= half;
        }
        out[4] = ahead_x * car->cos + ahead_y * car->sin;
        out[5] = ahead_y * car->cos - ahead_x * car->sin;
        out[6] = line->type - 4.0f;
        out += FEATURES;
    }
    memset(out, 0, (SEGMENTS - size) * FEATURES * sizeof(float));
}

/* The cars' rows: x, y, heading, speed, length, width, goal_x, goal_y. */
World *drive_make(int num_cars, const float *cars, int num_lines, const int *line_start,
                  const int *types, const float *xs, const float *ys) {
    World *world = calloc(1, sizeof(World));
    world->num_cars = num_cars;
    world->num_entities = num_cars + num_lines;
    world->entities = calloc(world->num_entities, sizeof(Entity));
    for (int c = 0; c < num_cars; c++, cars += 8) {
        Entity *car = &world->entities[c];
        car->type = 1;
        car->start_x = cars[0];
        car->start_y = cars[1];
        car->start_heading = cars[2];
        car->start_speed = cars[3];
        car->length = cars[4];
        car->width = cars[5];
        car->goal_x = cars[6];
        car->goal_y = cars[7];
    }
    world->min_x = world->min_y = INFINITY;
    world->max_x = world->max_y = -INFINITY;
    for (int k = 0; k < num_lines; k++) {
        Entity *line = &world->entities[num_cars + k];
        line->type = types[k];
        line->size = line_start[k + 1] - line_start[k];
        line->xs = malloc(line->size * sizeof(float));
        line->ys = malloc(line->size * sizeof(float));
        memcpy(line->xs, &xs[line_start[k]], line->size * sizeof(float));
        memcpy(line->ys, &ys[line_start[k]], line->size * sizeof(float));
        for (int p = 0; p < line->size; p++) {
            world->min_x = fminf(world->min_x, line->xs[p]);
            world->max_x = fmaxf(world->max_x, line->xs[p]);
            world->min_y = fminf(world->min_y, line->ys[p]);
            world->max_y = fmaxf(world->max_y, line->ys[p]);
        }
    }
    fill_cells(world);
    fill_lists(world);
    set_out(world);
    return world;
}

void drive_free(World *world) {
    for (int e = world->num_cars; e < world->num_entities; e++) {
        free(world->entities[e].xs);
        free(world->entities[e].ys);
    }
    free(world->entities);
    free(world->cells);
    free(world->list_start);
    free(world->lists);
    free(world);
}

void drive_observe(const World *world, float *observations) {
    memset(observations, 0, (size_t)world->num_cars * OBSERVATION * sizeof(float));
    for (int c = 0; c < world->num_cars; c++)
        observe_car(world, &world->entities[c], &observations[(size_t)c * OBSERVATION]);
}

void drive_reset(World *world, float *observations) {
    set_out(world);
    drive_observe(world, observations);
}

/* `actions`: an index into ACCELERATIONS and one into STEERINGS a car. */
void drive_step(World *world, const int *actions, float *observations, float *rewards) {
    world->timestep++;
    for (int c = 0; c < world->num_cars; c++) {
        rewards[c] = 0.0f;
        move(&world->entities[c], ACCELERATIONS[actions[2 * c]], STEERINGS[actions[2 * c + 1]]);
    }
    for (int c = 0; c < world->num_cars; c++) {
        Entity *car = &world->entities[c];
        car->contact = contact_of(world, car);
        if (car->contact != NO_CONTACT) rewards[c] = -0.5f;
        float dx = car->goal_x - car->x, dy = car->goal_y - car->y;
        if (sqrtf(dx * dx + dy * dy) < 2.0f) {
            rewards[c] += 1.0f;
            car->reached = 1;
        }
    }
    for (int c = 0; c < world->num_cars; c++) {
        Entity *car = &world->entities[c];
        if (!car->reached) continue;
        place(car, car->start_x, car->start_y, car->start_heading, car->start_speed);
        car->reached = 0;
        car->respawned_at = world->timestep;
    }
    drive_observe(world, observations);
}

/* All worlds one after the other, their cars' rows too. */
void drive_step_all(World **worlds, int num_worlds, const int *actions, float *observations,
                    float *rewards) {
    for (int w = 0; w < num_worlds; w++) {
        drive_step(worlds[w], actions, observations, rewards);
        actions += 2 * worlds[w]->num_cars;
        rewards += worlds[w]->num_cars;
        observations += (size_t)worlds[w]->num_cars * OBSERVATION;
    }
}
